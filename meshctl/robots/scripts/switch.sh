# switch ID HOW WAIT: makes a release the current one, and rolls back unless it is healthy within WAIT seconds. HOW is
# `restart`, or `reload` if only the configuration differs, which keeps all messages of the daemon. Completes even if
# the operator's connection breaks. Prints `result=...`, then why, then the last log.
id=$1 how=$2 wait_s=$3
trap '' HUP INT PIPE
alone
none_masked
[ -d "$root/releases/$id" ] || die no-release "release $id is not installed here"
was=$(release_of current)
# an interrupted switch is not proven: roll back to the release before it
[ ! -e "$root/unproven" ] || read -r was <"$root/unproven" || was=

# bring HOW: run the units of the current release, and remove our other units.
bring() {
	for service in $collector_unit $hosts_unit $bridge_unit $unit; do
		if [ -e "$root/current/$service" ]; then
			cp "$root/current/$service" "$units/$service.new" && mv -f "$units/$service.new" "$units/$service" || return 1
		elif [ -e "$units/$service" ]; then
			systemctl disable --now "$service" >/dev/null 2>&1
			rm -f "$units/$service"
		fi
	done
	systemctl daemon-reload
	for service in $(ours); do
		systemctl enable "$service" >/dev/null 2>&1 || return 1
		if [ "$1" = reload ] && systemctl is-active "$service" >/dev/null 2>&1 && takes_over "$service"; then continue; fi
		systemctl reset-failed "$service" 2>/dev/null
		systemctl restart "$service" || return 1
	done
}

# takes_over UNIT: reload a running service without an interruption, if possible.
takes_over() {
	# it reads its configuration when it starts, and keeps nothing
	[ "$1" != "$collector_unit" ] || return 1
	# the others read none of them
	[ "$1" = "$unit" ] || return 0
	changes=$(mesh reload 2>&1) || return 1
	case $changes in *"takes effect after a restart"*) return 1 ;; esac
}

# well HOW: bring up the current release and wait until it is healthy; `reason` is why it is not.
well() {
	reason=
	if bring "$1"; then
		reason=$(health prove "$wait_s" "$before" $(ours) 2>&1) && [ -z "$reason" ]
	else
		# one check is enough for the reason: do not leave the robot without its daemon for longer
		reason=$(health prove 0 "$before" $(ours) 2>&1)
		[ -n "$reason" ] || reason="systemd could not start it"
		return 1
	fi
}

# remove releases, trees and wheels that are no longer used
tidy() {
	keep=" $(release_of current) $(release_of previous) "
	for release in "$root"/releases/*; do
		case $keep in *" ${release##*/} "*) ;; *) rm -rf "$release" ;; esac
	done
	used=" $(for link in "$root"/releases/*/lib; do basename "$(readlink "$link")"; done | tr '\n' ' ')"
	for tree in "$root"/trees/*; do
		case $used in *" ${tree##*/} "*) ;; *) rm -rf "$tree" ;; esac
	done
	for wheel in "$root"/wheels/*; do
		grep -qF " ${wheel##*/}" "$root"/releases/*/wheels 2>/dev/null || rm -f "$wheel"
	done
	rm -f "$root"/wheels/.*.part
}

trap 'rm -f "$root/.claim"' EXIT
before=$(health before 2>/dev/null) || before='[[], {}, ""]'
echo "$was" >"$root/unproven" && sync -f "$root"
point current "$id" || die no-space "cannot change $root/current"
if well "$how"; then
	[ -z "$was" ] || [ "$was" = "$id" ] || point previous "$was"
	rm -f "$root/unproven"
	tidy
	sync -f "$root"
	echo "result=switched"
	echo "online=$(health online 2>/dev/null)"
	exit 0
fi
why=$reason
journalctl --sync 2>/dev/null
log=$(journalctl -u "$unit" -u "$bridge_unit" -u "$hosts_unit" -u "$collector_unit" -n 12 --no-pager -o cat 2>/dev/null | sed 's/^/log=/')

if [ -n "$was" ] && [ "$was" != "$id" ] && [ -d "$root/releases/$was" ]; then
	point current "$was"
	if well "$how"; then
		echo "result=rolled-back"
	else
		echo "result=rolled-back-ill"
		echo "still=$(echo $reason)"
	fi
	rm -f "$root/unproven"
	rm -rf "$root/releases/$id"
elif [ -z "$was" ]; then
	for service in $(ours); do
		systemctl disable --now "$service" >/dev/null 2>&1
		rm -f "$units/$service"
	done
	rm -f "$root/current" "$root/unproven"
	rm -rf "$root/releases/$id"
	systemctl daemon-reload
	echo "result=removed"
else
	echo "result=ill"
fi
sync -f "$root"
echo "reason=$(echo $why)"
echo "$log"
