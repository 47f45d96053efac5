# facts [ADDRESS...]: state of the computer, its services and the daemon, in sections that start with `== NAME`. Changes
# nothing, and reads little from the disk, since status calls it often. The addresses are those of other computers on its
# switch.
echo "== services"
for service in $all_units; do
	# of a service that was never installed systemd knows ActiveState=inactive, UnitFileState= and LoadState=not-found
	systemctl show -p Id,LoadState,ActiveState,SubState,UnitFileState,NRestarts,Result "$service" 2>/dev/null
	echo
done
echo "== release"
echo "current=$(release_of current)"
echo "previous=$(release_of previous)"
[ ! -e "$root/unproven" ] && echo proven=yes || echo proven=no
if [ -e "$root/current/manifest" ]; then
	sed 's/^/file=/' "$root/current/manifest"
	(cd "$root/current" && sha256sum -c manifest 2>/dev/null) | sed -n 's/: FAILED.*//p' | sed 's/^/damaged=/'
	sed 's/^/wheel=/' "$root/current/wheels"
fi
echo "== others"
command -v ping >/dev/null 2>&1 || { [ $# = 0 ] || echo ping=missing; set --; }
for address; do
	# all at once, so that those that are off take one second together
	(ping -c 1 -W 1 "$address" >/dev/null 2>&1 && echo "answers=$address") &
done
wait
echo "== computer"
echo "now=$(date +%s)"
echo "uptime=$(cat /proc/uptime)"
echo "load=$(cat /proc/loadavg)"
echo "cpus=$(nproc 2>/dev/null)"
grep -E '^(MemTotal|MemAvailable):' /proc/meminfo | sed 's/: */=/'
there=$root
while [ ! -d "$there" ]; do there=$(dirname "$there"); done
df -Pk "$there" | awk 'END { print "disk=" $(NF - 4), $(NF - 2) }'
health facts 2>/dev/null
exit 0
