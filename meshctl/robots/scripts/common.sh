# Common part of all verbs: paths, locking, refusals. Runs under any POSIX sh (dash, bash, busybox ash).
#
#   /opt/udp-mesh/wheels/           wheels as uploaded, shared by releases
#   /opt/udp-mesh/trees/TREE/       wheels unpacked, shared by releases; .sums has the hash of every file
#   /opt/udp-mesh/releases/ID/      bin/udp-mesh, etc/ (configuration, keys), lib -> its tree, the unit, manifest
#   /opt/udp-mesh/current           -> the release that runs; one rename changes code, configuration, keys and unit
#   /opt/udp-mesh/previous          -> the release to roll back to
#   /opt/udp-mesh/unproven          exists until a switch is proven healthy
set -u
umask 022
LC_ALL=C
PATH=$PATH:/usr/local/sbin:/usr/sbin:/sbin
export LC_ALL PATH
root=/opt/udp-mesh
unit=udp-mesh.service
bridge_unit=udp-mesh-ros1.service
hosts_unit=udp-mesh-hosts.service
collector_unit=udp-mesh-collector.service
all_units="$unit $bridge_unit $hosts_unit $collector_unit"
units=/etc/systemd/system
socket=/run/udp-mesh/udp-mesh.sock
account=udp-mesh
# longer than any script of a deploy
claim_s=900

# die CODE TEXT: refuse, with one line for meshctl and the operator.
die() {
	echo "refused $*" >&2
	exit 65
}

# release_of LINK: the release that a link points to; empty for none.
release_of() {
	target=$(readlink "$root/$1" 2>/dev/null) || return 0
	echo "${target##*/}"
}

# point LINK RELEASE: in one rename, so there is always either the old one or the new one.
point() {
	ln -sfn "releases/$2" "$root/.$1.new" && mv -fT "$root/.$1.new" "$root/$1"
}

# alone: take the lock, which ends with this process. Between the scripts of one command the robot is locked by a claim,
# `OWNER UPTIME BOOT` in $root/.claim, which ends with a reboot or after $claim_s.
alone() {
	mkdir -p "$root" || die no-space "cannot make $root"
	exec 9>"$root/.lock"
	flock -n 9 || die busy "another command changes this robot right now"
	claimed_by
	[ -z "$claimer" ] || [ "$claimer" = "$owner" ] || die busy "locked by $claimer for ${claimed_s} s"
}

claimed_by() {
	claimer='' claimed_s=0 boot=$(cat /proc/sys/kernel/random/boot_id)
	read -r uptime _ </proc/uptime
	uptime=${uptime%.*}
	[ -e "$root/.claim" ] || return 0
	read -r claimer since when <"$root/.claim"
	claimed_s=$((uptime - since))
	[ "$when" = "$boot" ] && [ "$claimed_s" -lt "$claim_s" ] || claimer=
}

mesh() { "$root/current/bin/udp-mesh" "$@"; }

# ours: the units that are installed here, the daemon's first.
ours() { for service in $all_units; do [ ! -e "$units/$service" ] || echo "$service"; done; }

# none_masked: refuse if a unit is masked (`systemctl mask`).
none_masked() {
	for service in $all_units; do
		case $(systemctl is-enabled "$service" 2>/dev/null) in
		masked*) die masked "masked unit: $service" ;;
		esac
	done
}

# health WORD...: run health.py ($health_program) in the Python of the current release.
health() {
	read -r python 2>/dev/null <"$root/current/python" || return 1
	"$python" -I -c "$health_program" "$@"
}
