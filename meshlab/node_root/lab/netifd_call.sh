# `later sh /rom/lab/netifd VERB`: a call that returns at once. netifd handles calls in the order in which they come, so
# each one learns which call came before it.
later() {
	read -r before 2>/dev/null </tmp/run/netifd.call || before=
	CALL_BEFORE=$before /rom/lab/genuine/busybox setsid "$@" </dev/null >/dev/null 2>&1 &
	echo $! >/tmp/run/netifd.call
}
