# logs LINES SINCE: the daemon's last words; SINCE as journalctl takes it, or empty.
if [ -n "$2" ]; then
	journalctl -u "$unit" -n "$1" --since "$2" --no-pager -o short-iso
else
	journalctl -u "$unit" -n "$1" --no-pager -o short-iso
fi
