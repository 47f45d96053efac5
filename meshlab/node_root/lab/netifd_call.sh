# `later sh /rom/lab/netifd VERB`: a call that returns at once. netifd handles calls in the order in which they come, so
# each one learns which call came before it.
later() {
	read -r before 2>/dev/null </tmp/run/netifd.call || before=
	CALL_BEFORE=$before /rom/lab/genuine/busybox setsid "$@" </dev/null >/dev/null 2>&1 &
	echo $! >/tmp/run/netifd.call
}
# is_call PID: whether a process is a call that has not ended. One that has just been forked is still wifi or ubus, and
# one that is replacing its program has no command line; any other process has the number of a call that ended.
is_call() {
	case $(tr '\0' ' ' 2>/dev/null <"/proc/$1/cmdline") in
	*lab/netifd* | *wifi* | *ubus*) ;;
	'') [ -d "/proc/$1" ] && ! grep -q '^State:.*[ZX]' "/proc/$1/status" 2>/dev/null ;;
	*) return 1 ;;
	esac
}
