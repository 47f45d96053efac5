# Removes a station entry that has become stale because the neighbor's radio restarted, and only then. Shell functions;
# the caller appends calls of `flush_stale`, `flush_restarted` or `watch_stale`.
#
# A radio that restarts counts its frames from 0, while the holder of an old entry goes on with the block acknowledgement
# window it had and drops the neighbor's unicast frames; broadcasts pass. Whether that is so is observed here, on the
# holder: the neighbor is heard, and answers no echo request of batman-adv (layer 2: no firewall has a part in it).
# Removing the entry of a radio that did not restart does the same harm the other way round.
HEARD_MS=2000  # a neighbor sends several times a second: beacons, and OGMs that it originates or repeats
ECHOES=3       # lost all in a row by chance: after seven attempts each on the air, a link that carries nothing anyway
WATCH_PAUSE_S=2
FLUSHES=3      # by one watch, for each entry: where removing it does not help, repeating it is no remedy

# station DEV MAC FIELD: the number that iw prints behind FIELD (`inactive time`, ms; `connected time`, s)
station() { iw dev "$1" station get "$2" 2>/dev/null | sed -n "s/.*$3:[^0-9]*\([0-9]*\).*/\1/p"; }

is_heard() {
	inactive=$(station "$1" "$2" 'inactive time')
	[ "${inactive:-$HEARD_MS}" -lt $HEARD_MS ]
}

is_old() { # DEV MAC SECONDS: the entry is at least that old
	connected=$(station "$1" "$2" 'connected time')
	[ "${connected:--1}" -ge "$3" ]
}

mesh_of() { # DEV: the batman-adv interface that it is a hard interface of
	mesh=$(readlink "/sys/class/net/$1/master")
	mesh=${mesh##*/}
	[ -n "$mesh" ] || for mesh in /sys/class/net/bat*; do mesh=${mesh##*/} && break; done
	[ -e "/sys/class/net/$mesh" ]
}

# echo_state DEV MAC: ECHO = answered, lost, or unknown where this cannot be asked
echo_state() {
	ECHO=unknown
	mesh_of "$1" || return 0
	# 19.07's takes -m, later ones say that it will go
	answer=$(batctl meshif "$mesh" ping -c "${3:-$ECHOES}" -t 1 "$2" 2>/dev/null)
	case $answer in
	PING* | *' bytes from '* | *'timed out'* | *nreachable*) ;;
	*) answer=$(batctl -m "$mesh" ping -c "${3:-$ECHOES}" -t 1 "$2" 2>/dev/null) ;;
	esac
	case $answer in
	*' bytes from '*) ECHO=answered ;;
	*'timed out'*) ECHO=lost ;;
	esac
}

remove() { # DEV MAC
	if iw dev "$1" station del "$2" 2>/dev/null; then echo "gone $2"; else echo "kept $2"; fi
}

# flush_stale DEVICES MAC SECONDS: removes the entry if it is that old and stale; says `gone`, `kept` (it cannot be
# removed), `answers`, or `unknown` MAC
flush_stale() {
	for dev in $1; do
		is_old "$dev" "$2" "$3" && is_heard "$dev" "$2" || continue
		echo_state "$dev" "$2"
		case $ECHO in
		answered) echo "answers $2" ;;
		unknown) echo "unknown $2" ;;
		# still there, still heard: not just gone out of range meanwhile
		*) ! is_old "$dev" "$2" "$3" || ! is_heard "$dev" "$2" || remove "$dev" "$2" ;;
		esac
	done
}

# flush_restarted DEVICES MAC SECONDS: removes an entry that is that old; for a radio that was seen to have restarted
flush_restarted() {
	for dev in $1; do
		! is_old "$dev" "$2" "$3" || remove "$dev" "$2"
	done
}

# watch_stale SECONDS DEV/MAC...: for so long, removes those entries that are older than the watch and become stale
watch_stale() {
	read -r up _ </proc/uptime
	began=${up%.*} until=$((${up%.*} + $1))
	shift
	left=$((FLUSHES * $#))
	while sleep $WATCH_PAUSE_S && read -r up _ </proc/uptime && [ "${up%.*}" -lt $until ] && [ $left -gt 0 ]; do
		for entry; do
			watched=${entry%%/*} age=$((${up%.*} - began))
			is_old "$watched" "${entry#*/}" $age && is_heard "$watched" "${entry#*/}" || continue
			# one echo request tells of a neighbor that answers; only one that does not is asked again
			echo_state "$watched" "${entry#*/}" 1
			[ "$ECHO" = lost ] || continue
			case $(flush_stale "$watched" "${entry#*/}" $age) in gone*) left=$((left - 1)) ;; esac
		done
	done
}
