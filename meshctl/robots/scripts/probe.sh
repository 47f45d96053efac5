# probe PYTHON ROS [ADDRESS...]: all facts that a deploy depends on, as NAME=VALUE lines. Changes nothing. The addresses
# are those of peers in other networks.
python=$1 ros=$2
[ $# -lt 2 ] || shift 2
if command -v ip >/dev/null 2>&1; then
	for address; do
		ip route get "$address" >/dev/null 2>&1 || echo "no_route=$address"
	done
fi

echo "arch=$(uname -m)"
echo "now=$(date +%s)"
echo "uid=$(id -u)"
[ -d /run/systemd/system ] && echo systemd=yes || echo systemd=no
missing=
for tool in systemctl sha256sum tar flock readlink df awk; do
	command -v "$tool" >/dev/null 2>&1 || missing="$missing $tool"
done
echo "missing=${missing# }"
for tool in ssh ssh-keygen; do command -v "$tool" >/dev/null 2>&1 || echo no_ssh=yes; done
[ -z "$ros" ] || [ -e "/opt/ros/$ros/setup.bash" ] || echo "no_ros=/opt/ros/$ros/setup.bash"

if path=$(command -v "$python" 2>/dev/null); then
	# any Python since 2.7 answers this, so that a wrong one can be named
	"$path" -c '
import struct, sys, platform
print("python=%d.%d.%d" % tuple(sys.version_info[:3]))
print("implementation=" + platform.python_implementation())
print("bits=%d" % (8 * struct.calcsize("P")))
print("libc=" + " ".join(platform.libc_ver()))
print("executable=" + sys.executable)
for name in ("zipfile", "compileall", "asyncio"):
    try:
        __import__(name)
    except ImportError:
        print("no_module=" + name)
' 2>/dev/null || echo "python=broken"
fi

there=$root
while [ ! -d "$there" ]; do there=$(dirname "$there"); done
echo "free_kib=$(df -Pk "$there" | awk 'END { print $(NF - 2) }')"
[ -w "$there" ] && echo writable=yes || echo writable=no
# the mount that holds it is the last one named for the longest path above it
awk -v there="$(readlink -f "$there")/" '
	{ place = $5 == "/" ? "/" : $5 "/" }
	index(there, place) == 1 && length(place) >= longest { longest = length(place); options = "," $6 "," }
	END { if (options ~ /,noexec,/) print "noexec=yes" }
' /proc/self/mountinfo 2>/dev/null

# a release is intact if it and its packages match their manifests; a damaged one is installed again
is_whole() { (cd "$1" 2>/dev/null && sha256sum -c --quiet "$2") >/dev/null 2>&1; }
has_whole_tree() { case $whole in *" $(basename "$(readlink "$1/lib")") "*) ;; *) return 1 ;; esac }
current=$(release_of current) whole=' '
echo "current=$current"
echo "previous=$(release_of previous)"
for tree in "$root"/trees/*; do
	is_whole "$tree" .sums || continue
	whole="$whole${tree##*/} "
	echo "tree=${tree##*/}"
done
for release in "$root"/releases/*; do
	! is_whole "$release" manifest || ! has_whole_tree "$release" || echo "release=${release##*/}"
done
[ ! -e "$root/unproven" ] && echo proven=yes || echo proven=no
if [ -n "$current" ]; then
	sed 's/^/file=/' "$root/current/manifest" 2>/dev/null || echo damaged=manifest
	sed -n 's/^port = /port=/p' "$root/current/etc/udp-mesh.toml" 2>/dev/null | sed 1q
	# what was changed by hand, or by a failing disk
	(cd "$root/current" && sha256sum -c manifest) 2>/dev/null | sed -n 's/: FAILED.*//p' | sed 's/^/damaged=/'
	[ -e "$root/current/lib/.sums" ] || echo damaged=lib
	has_whole_tree "$root/current" ||
		(cd "$root/current/lib" && sha256sum -c .sums) 2>/dev/null | sed -n 's/: FAILED.*//p' | sed 's|^|damaged=lib/|'
	for service in $all_units; do
		[ ! -e "$root/current/$service" ] || cmp -s "$root/current/$service" "$units/$service" ||
			echo "damaged=$units/$service"
	done
	id "$account" >/dev/null 2>&1 || echo "damaged=the user $account"
fi
for service in $all_units; do
	echo "unit=$service $(systemctl is-active "$service" 2>/dev/null) $(systemctl is-enabled "$service" 2>/dev/null)"
done
