# Locks: `lock NAME` waits, `try_lock` does not, `unlock NAME` releases. The lock of a dead process is free.
try_lock() {
	ln -s $$ "/tmp/run/lock.$1" 2>/dev/null && return
	holder=$(readlink "/tmp/run/lock.$1")
	[ -z "$holder" ] || kill -0 "$holder" 2>/dev/null || rm -f "/tmp/run/lock.$1"
	return 1
}
lock() { until try_lock "$1"; do /rom/lab/genuine/busybox usleep 10000; done; }
unlock() { rm -f "/tmp/run/lock.$1"; }
# A number from 0 to MAX, from the board's seed: the same sequence in every fleet with that seed.
chance() { # MOST
	. /lab/node/board
	read -r drawn 2>/dev/null </tmp/run/drawn || drawn=$((SEED + 1))
	drawn=$(((drawn * 1103515245 + 12345) % 2147483648))
	echo $drawn >/tmp/run/drawn
	echo $((drawn / 65536 % ($1 + 1)))
}
