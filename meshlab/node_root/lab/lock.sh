# Locks: `lock NAME` waits, `try_lock` does not, `unlock NAME` releases. The lock of a dead process is free.
try_lock() {
	ln -s $$ "/tmp/run/lock.$1" 2>/dev/null && return
	holder=$(readlink "/tmp/run/lock.$1")
	[ -z "$holder" ] || kill -0 "$holder" 2>/dev/null || break_lock "$1" "$holder"
	return 1
}
# The holder may have unlocked before it ended, and the lock may be another process's by now: one process at a time
# breaks locks, and it looks again.
break_lock() { # NAME HOLDER
	if ! ln -s $$ "/tmp/run/break.$1" 2>/dev/null; then
		breaker=$(readlink "/tmp/run/break.$1")
		[ -z "$breaker" ] || kill -0 "$breaker" 2>/dev/null || rm -f "/tmp/run/break.$1"
		return
	fi
	[ "$(readlink "/tmp/run/lock.$1")" != "$2" ] || rm -f "/tmp/run/lock.$1"
	rm -f "/tmp/run/break.$1"
}
lock() { until try_lock "$1"; do /rom/lab/genuine/busybox usleep 10000; done; }
unlock() { rm -f "/tmp/run/lock.$1"; }
# A number from 0 to MAX, from the board's seed: the same sequence in every fleet with that seed. `draw` sets the variable
# of its name, `chance` prints it.
draw() { # MOST
	. /lab/node/board
	read -r drawn 2>/dev/null </tmp/run/drawn || drawn=$((SEED + 1))
	drawn=$(((drawn * 1103515245 + 12345) % 2147483648))
	echo $drawn >/tmp/run/drawn
	draw=$((drawn / 65536 % ($1 + 1)))
}
chance() { # MOST
	draw "$1"
	echo $draw
}
