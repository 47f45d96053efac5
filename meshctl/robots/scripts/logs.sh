# logs LINES SINCE: the last log lines of all our services; SINCE as for journalctl, or empty.
set -- -n "$1" ${2:+--since "$2"}
journalctl -u "$unit" -u "$bridge_unit" -u "$hosts_unit" -u "$collector_unit" "$@" --no-pager -o short-iso
