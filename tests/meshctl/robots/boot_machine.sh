# boot_machine.sh LOWER HERE OPT_KIB PREFIX, as the first process of new pid, mount, network, ipc, uts and cgroup
# namespaces: lays a machine's own writes (HERE/upper) over the Debian in LOWER and becomes its systemd.
set -eu
lower=$1 here=$2 opt_kib=$3 prefix=$4
root=$here/root
mount --make-rprivate /
# no test cuts the power of the disk, and a real sync waits for whatever else this computer writes
rm -rf "$here/work/work/incompat"
mount -t overlay overlay -o "volatile,lowerdir=$lower,upperdir=$here/upper,workdir=$here/work" "$root"
mount -t proc -o nosuid,nodev,noexec proc "$root/proc"
# as in any container: the kernel's settings are not this machine's
mount --bind "$root/proc/sys" "$root/proc/sys"
mount -o remount,bind,ro "$root/proc/sys"
mount -t sysfs -o ro,nosuid,nodev,noexec sysfs "$root/sys"
mount -t cgroup2 -o nosuid,nodev,noexec cgroup2 "$root/sys/fs/cgroup"
mount -t tmpfs -o mode=755 tmpfs "$root/dev"
for node in "null 3" "zero 5" "full 7" "random 8" "urandom 9"; do
	mknod -m 666 "$root/dev/${node% *}" c 1 "${node#* }"
done
mknod -m 666 "$root/dev/tty" c 5 0
mkdir "$root/dev/pts" "$root/dev/shm"
mount -t devpts -o newinstance,ptmxmode=0666,mode=620,gid=5 devpts "$root/dev/pts"
mount -t tmpfs -o mode=1777 tmpfs "$root/dev/shm"
ln -s pts/ptmx "$root/dev/ptmx"
ln -s /proc/self/fd "$root/dev/fd"
for name in 0:stdin 1:stdout 2:stderr; do ln -s "fd/${name%:*}" "$root/dev/${name#*:}"; done
mount -t tmpfs -o mode=755,nosuid,nodev tmpfs "$root/run"
[ -z "$opt_kib" ] || mount -t tmpfs -o "size=${opt_kib}k,mode=755" tmpfs "$root/opt"
mkdir -p "$root/opt/python"
mount --bind -o ro "$prefix" "$root/opt/python"
cd "$root"
pivot_root . .
umount -l .
# another Python than Debian's may bring its library with it
echo /opt/python/lib >/etc/ld.so.conf.d/opt-python.conf
ldconfig
# without what would change the kernel that all machines share
exec env -i container=other PATH=/usr/sbin:/usr/bin:/sbin:/bin \
	setpriv --bounding-set -sys_time,-sys_module,-sys_rawio,-syslog /usr/lib/systemd/systemd --log-target=journal
