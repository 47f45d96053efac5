# watch: how the service and the daemon fare, in sections that a line `== NAME` begins. Changes nothing.
echo "== service"
echo "active=$(systemctl is-active "$unit" 2>/dev/null)"
echo "enabled=$(systemctl is-enabled "$unit" 2>/dev/null)"
echo "current=$(release_of current)"
echo "previous=$(release_of previous)"
[ ! -e "$root/unproven" ] && echo proven=yes || echo proven=no
echo "now=$(date +%s)"
echo "== status"
mesh status --json 2>/dev/null
echo "== topics"
mesh topics --json 2>/dev/null
exit 0
