# What every verb knows: the places, and how a refusal is told. Runs under any POSIX sh (dash, bash, busybox ash).
#
#   /opt/udp-mesh/wheels/           wheels as they came, shared by releases
#   /opt/udp-mesh/trees/TREE/       wheels unpacked, shared by releases; .sums has the hash of every file
#   /opt/udp-mesh/releases/ID/      bin/udp-mesh, etc/ (configuration, keys), lib -> its tree, the unit, manifest
#   /opt/udp-mesh/current           -> the release that runs; one rename changes code, configuration, keys and unit
#   /opt/udp-mesh/previous          -> the release to go back to
#   /opt/udp-mesh/unproven          exists while a switch has not proved itself
set -u
umask 022
LC_ALL=C
PATH=$PATH:/usr/local/sbin:/usr/sbin:/sbin
export LC_ALL PATH
root=/opt/udp-mesh
unit=udp-mesh.service
bridge_unit=udp-mesh-ros1.service
units=/etc/systemd/system
socket=/run/udp-mesh/udp-mesh.sock
account=udp-mesh
# longer than the longest script of a deploy takes
claim_s=900

# die WORD TEXT: one line for the operator; the first word is for programs.
die() {
	echo "refused $*" >&2
	exit 65
}

# release_of LINK: the name of the release a link names, empty for none.
release_of() {
	target=$(readlink "$root/$1" 2>/dev/null) || return 0
	echo "${target##*/}"
}

# point LINK RELEASE: in one rename, so there is always either the old one or the new one.
point() {
	ln -sfn "releases/$2" "$root/.$1.new" && mv -fT "$root/.$1.new" "$root/$1"
}

# alone: one change at a time; the lock goes with this process. Between the scripts of one command the robot is held by
# a claim: `OWNER UPTIME BOOT`, in $root/.claim. A claim ends with a boot, and by itself when nobody gives it back.
alone() {
	mkdir -p "$root" || die no-space "cannot make $root"
	exec 9>"$root/.lock"
	flock -n 9 || die busy "another command changes this robot right now"
	claimed_by
	[ -z "$claimer" ] || [ "$claimer" = "$owner" ] || die busy "$claimer changes this robot, for ${claimed_s} s now"
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
ours() { for service in $unit $bridge_unit; do [ ! -e "$units/$service" ] || echo "$service"; done; }

# none_masked: what somebody has forbidden to start (`systemctl mask`) is started by none of us.
none_masked() {
	for service in $unit $bridge_unit; do
		case $(systemctl is-enabled "$service" 2>/dev/null) in
		masked*) die masked "somebody has masked $service there" ;;
		esac
	done
}

# health WORD...: what health.py, which stands in $health_program, tells in the Python of the current release.
health() {
	read -r python 2>/dev/null <"$root/current/python" || return 1
	"$python" -I -c "$health_program" "$@"
}
