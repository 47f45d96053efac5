# logs LINES SINCE: the last words of the daemon and of the bridge; SINCE as journalctl takes it, or empty.
set -- -n "$1" ${2:+--since "$2"}
journalctl -u "$unit" -u "$bridge_unit" "$@" --no-pager -o short-iso
