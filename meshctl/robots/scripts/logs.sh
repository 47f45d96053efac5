# logs LINES SINCE: the last log lines of the daemon and the bridge; SINCE as for journalctl, or empty.
set -- -n "$1" ${2:+--since "$2"}
journalctl -u "$unit" -u "$bridge_unit" -u "$hosts_unit" "$@" --no-pager -o short-iso
