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
# await_taken: returns once the latest call has read its configuration. netifd is one process: whoever asks after a reload
# has returned is answered after it, and sees the radios that it will set up as pending (netifd ubus.c, wireless-device.uc).
await_taken() {
	read -r latest 2>/dev/null </tmp/run/netifd.call || return 0
	while read -r taken 2>/dev/null </tmp/run/netifd/taken || taken=; [ "$taken" != "$latest" ] && is_call "$latest"; do
		/rom/lab/genuine/busybox usleep 10000
	done
}
