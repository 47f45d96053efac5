# One at a time: `lock NAME` waits for its turn, `try_lock` does not, `unlock NAME` ends it. A holder that died holds nothing.
try_lock() {
	ln -s $$ "/tmp/run/lock.$1" 2>/dev/null && return
	holder=$(readlink "/tmp/run/lock.$1")
	[ -z "$holder" ] || kill -0 "$holder" 2>/dev/null || rm -f "/tmp/run/lock.$1"
	return 1
}
lock() { until try_lock "$1"; do /rom/lab/genuine/busybox usleep 10000; done; }
unlock() { rm -f "/tmp/run/lock.$1"; }
# A number from 0 to MOST, from the board's seed: the same series in every fleet with that seed.
chance() { # MOST
	. /lab/node/board
	read -r drawn 2>/dev/null </tmp/run/drawn || drawn=$((SEED + 1))
	drawn=$(((drawn * 1103515245 + 12345) % 2147483648))
	echo $drawn >/tmp/run/drawn
	echo $((drawn / 65536 % ($1 + 1)))
}
