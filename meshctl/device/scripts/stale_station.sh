# Removes a station entry only if it is stale because the neighbor's radio restarted. Shell functions; the caller
# appends calls of `flush_stale`, `flush_restarted` or `watch_stale`.
#
# A radio that restarts counts its frames from 0, while the holder of an old entry keeps its block acknowledgment window
# and drops the neighbor's unicast frames; broadcasts pass. The holder detects that here: it hears the neighbor, but gets
# no reply to batman-adv echo requests (layer 2, so no firewall matters). Removing the entry of a radio that did not
# restart causes the same loss in the other direction.
#
# Each traffic class has a window of its own. dropbear marks its packets AF21, so they may be dropped although the replies
# to echo requests, which are of another class, arrive. So `flush_stale` is told where the neighbor's dropbear listens if
# nothing but a stale entry explains that nobody can log in.
#
# `catch_up` is for the other way round: this node's radio restarted, and the neighbor, which nobody can ask, holds the old
# entry. It drops only what is numbered before its window, half of all numbers at most, so this node sends so many frames.
HEARD_MS=2000  # a neighbor sends several times a second: beacons, and OGMs that it originates or repeats
ECHOES=3       # each is sent up to seven times on the air: a link that loses all of them is useless anyway
LOGIN_S=3      # for a connection to dropbear: TCP tries at 0 and 1 s, and again at 3 s
WATCH_PAUSE_S=2
FLUSHES=3      # per watch and entry: if removing it did not help, repeating it does not either
CONFIRMED_S=20 # a watch of the node that changes ends so long after the confirmation: neighbors are queried right after it
SENDERS=40     # of `catch_up`: each sends one echo request per second, until it is answered; 2,080 in all, of 4,096 numbers
SENT_EACH=52

# number_after WORDS TEXT: NUMBER, the one that follows WORDS and a colon; empty if there is none
number_after() {
	NUMBER=${2#*"$1":}
	[ "$NUMBER" != "$2" ] || NUMBER=''
	NUMBER=${NUMBER#"${NUMBER%%[0-9]*}"}
	NUMBER=${NUMBER%%[!0-9]*}
}

# look DEV MAC: STATION, what iw prints of the entry
look() { STATION=$(iw dev "$1" station get "$2" 2>/dev/null); }

# is_heard, is_old SECONDS: of the latest look
is_heard() {
	number_after 'inactive time' "$STATION"
	[ "${NUMBER:-$HEARD_MS}" -lt $HEARD_MS ]
}

is_old() {
	number_after 'connected time' "$STATION"
	[ "${NUMBER:--1}" -ge "$1" ]
}

mesh_of() { # DEV: the batman-adv interface that it is a hard interface of
	# asked once: a watch would start a process for it every time
	[ "$1" != "$mesh_dev" ] || [ ! -e "/sys/class/net/$mesh" ] || return 0
	mesh_dev=$1
	mesh=$(readlink "/sys/class/net/$1/master")
	mesh=${mesh##*/}
	[ -n "$mesh" ] || for mesh in /sys/class/net/bat*; do mesh=${mesh##*/} && break; done
	[ -e "/sys/class/net/$mesh" ]
}

# echo_state DEV MAC: sets ECHO to answered, lost, or unknown if no echo request can be sent
echo_state() {
	ECHO=unknown
	mesh_of "$1" || return 0
	# batctl of 19.07 needs -m, which later versions deprecate
	interface_option=meshif
	answer=$(batctl meshif "$mesh" ping -c "${3:-$ECHOES}" -t 1 "$2" 2>/dev/null)
	case $answer in
	PING* | *' bytes from '* | *'timed out'* | *nreachable*) ;;
	*) interface_option=-m && answer=$(batctl -m "$mesh" ping -c "${3:-$ECHOES}" -t 1 "$2" 2>/dev/null) ;;
	esac
	case $answer in
	*' bytes from '*) ECHO=answered ;;
	*'timed out'*) ECHO=lost ;;
	esac
}

remove() { # DEV MAC
	if iw dev "$1" station del "$2" 2>/dev/null; then echo "gone $2"; else echo "kept $2"; fi
}

# try_login ADDRESS PORT: sets LOGIN to answered (a refusal, or a connection without a word from dropbear, is an answer),
# silent (nothing comes back, although the address is known on the link), or unknown
try_login() {
	LOGIN=unknown
	command -v nc >/dev/null || return 0
	mkdir -p /tmp/meshctl
	nc "$1" "$2" </dev/null >/tmp/meshctl/login.$$ 2>&1 &
	login=$! left_s=$LOGIN_S
	while [ $LOGIN = unknown ] && [ $left_s -gt 0 ]; do
		pause 1
		left_s=$((left_s - 1))
		! grep -q -e SSH- -e refused /tmp/meshctl/login.$$ || LOGIN=answered
	done
	[ $LOGIN = answered ] || case $(netstat -tn 2>/dev/null | grep -F " $1:$2 ") in
	# 0x0: no device has answered for the address
	*SYN_SENT*) grep -q "^$1 .* 0x0 " /proc/net/arp || LOGIN=silent ;;
	?*) LOGIN=answered ;;
	esac
	kill "$login" 2>/dev/null
	wait "$login" 2>/dev/null
	rm -f /tmp/meshctl/login.$$
}

# is_announced MAC: the mesh still knows it as a client of its own. A node's batman-adv interface has another MAC after each
# boot, and the table that says so travels in the class of the echo requests.
is_announced() { [ -n "$1" ] && batctl $interface_option "$mesh" tg 2>/dev/null | grep -qiF " $1 "; }

# flush_stale DEVICES MAC SECONDS [ADDRESS PORT [MESH_MAC]]: removes the entry if it is that old and stale; prints `gone`, `kept` (it
# cannot be removed), `answers`, or `unknown` MAC. With ADDRESS and PORT of the neighbor's dropbear, a neighbor that answers
# echo requests has to let something come back from there, too, unless it announces MESH_MAC: then it has not restarted.
flush_stale() {
	for dev in $1; do
		look "$dev" "$2"
		is_old "$3" && is_heard || continue
		echo_state "$dev" "$2"
		if [ $ECHO = answered ] && [ -n "$4" ]; then
			try_login "$4" "$5"
			[ $LOGIN != silent ] || is_announced "$6" || ECHO=lost
		fi
		case $ECHO in
		answered) echo "answers $2" ;;
		unknown) echo "unknown $2" ;;
		# check again that it has not just gone out of range
		*) look "$dev" "$2" && is_old "$3" && is_heard && remove "$dev" "$2" ;;
		esac
	done
}

# flush_restarted DEVICES MAC SECONDS: removes an entry that is that old; for a radio that was observed to restart
flush_restarted() {
	for dev in $1; do
		look "$dev" "$2"
		! is_old "$3" || remove "$dev" "$2"
	done
}

# catch_up DEVICES MAC: sends echo requests to a neighbor that is heard and does not answer, until it does; prints
# `caught-up`, `silent` (it still does not answer), `answers`, or `unknown` MAC
catch_up() {
	for dev in $1; do
		look "$dev" "$2"
		is_old 0 && is_heard || continue
		echo_state "$dev" "$2"
		case $ECHO in
		answered) echo "answers $2" && continue ;;
		unknown) echo "unknown $2" && continue ;;
		esac
		senders=0
		while [ $senders -lt $SENDERS ]; do
			batctl $interface_option "$mesh" ping -i 0.01 -c $SENT_EACH -t 1 "$2" >/dev/null 2>&1 &
			senders=$((senders + 1))
		done
		wait
		echo_state "$dev" "$2"
		case $ECHO in answered) echo "caught-up $2" ;; *) echo "silent $2" ;; esac
	done
}

# pause SECONDS: a sleep without a process of its own; nothing is ever written into the FIFO
pause() {
	[ -p /tmp/meshctl/pause ] || mkfifo /tmp/meshctl/pause 2>/dev/null
	if [ -p /tmp/meshctl/pause ]; then
		read -r -t "$1" _ <>/tmp/meshctl/pause 2>/dev/null
		# 1: the time is over; more: this shell's read knows no time limit
		[ $? -le 1 ] || sleep "$1"
	else
		sleep "$1"
	fi
}

# last_change: LAST, the line about the change of this node that ended last (deadman.sh)
last_change() { LAST='' && read -r LAST 2>/dev/null </etc/meshctl/last; }

# watch_stale SECONDS DEV/MAC...: for SECONDS, removes entries that are older than the watch and become stale. With
# IS_OWN=yes, of a node of which no neighbor changes, it ends soon after the change of this node is confirmed.
watch_stale() {
	read -r up _ </proc/uptime
	began=${up%.*} until=$((${up%.*} + $1))
	shift
	left=$((FLUSHES * $#))
	last_change
	before=$LAST
	while pause $WATCH_PAUSE_S && read -r up _ </proc/uptime && [ "${up%.*}" -lt $until ] && [ $left -gt 0 ]; do
		[ -z "$IS_OWN" ] || last_change
		case $LAST in
		"$before") ;;
		*' confirmed '*) before=$LAST && [ $until -le $((${up%.*} + CONFIRMED_S)) ] || until=$((${up%.*} + CONFIRMED_S)) ;;
		esac
		for entry; do
			watched=${entry%%/*} age=$((${up%.*} - began))
			look "$watched" "${entry#*/}"
			is_old $age && is_heard || continue
			# one echo request suffices if the neighbor answers; otherwise flush_stale repeats it
			echo_state "$watched" "${entry#*/}" 1
			[ "$ECHO" = lost ] || continue
			case $(flush_stale "$watched" "${entry#*/}" $age) in gone*) left=$((left - 1)) ;; esac
		done
	done
}
