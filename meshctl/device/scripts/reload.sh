# A change's reload: makes the node take up changed files and waits until the effects that decide who can log in are in
# force. Sent with PACKAGES (UCI packages that changed), SERVICES (services to restart, by name) and SPEAK_FRAMES set
# before it; ends with 0 when every effect was seen.
#
#   reload_config -> procd has run what that triggered (`barrier`) -> netifd has set its interfaces and radios up
#   (`settle_radios`) -> procd has run what the interfaces triggered -> the firewall is loaded (`load_firewall`) ->
#   dropbear runs with its new options (`dropbear_is_new`)
#
# reload_config only sends events and always ends with 0. procd waits 1 s, then runs the init scripts one after the other,
# and loses their exit status (procd: service/trigger.c, the same from 19.07 to 25.12).
#
# of its own process: a restore may begin while the reload of its change still runs
BARRIER=meshctl-barrier-$$
PASSED=/tmp/meshctl/$BARRIER
BARRIER_LIMIT_S=90   # every reload, one after the other, on a slow board under load; a first one makes host keys
BLIND_S=10           # where procd does not take our trigger: about what its reloads take
NETIFD_LIMIT_S=20    # a radio with SAE or DFS takes longer, and so does a WAN without a server; the checks judge those
RADIO_LIMIT_S=8      # netifd may not have begun, or be between taking it down and up
DROPBEAR_LIMIT_S=15  # procd waits 5 s for the old process before it kills it
STATUS=0

changed() { # PACKAGE...: whether one of them is in PACKAGES
	for package; do
		case " $PACKAGES " in *" $package "*) return 0 ;; esac
	done
	return 1
}

fail() {
	echo "failed: $1" >&2
	STATUS=1
}

# until_s SECONDS COMMAND...: asks once a second; 1 when the time is over
until_s() {
	seconds=$1
	shift
	until "$@"; do
		[ "$seconds" -gt 0 ] || return 1
		seconds=$((seconds - 1))
		sleep 1
	done
}

# barrier: returns once procd has run every script that was triggered before. procd delays each trigger and queues the
# scripts in the order in which their delays end, so ours, triggered last with the same delay, runs last.
barrier() {
	rm -f "$PASSED"
	if ! ubus call service set "{\"name\":\"$BARRIER\",\"triggers\":[[\"config.change\",[\"if\",[\"eq\",\"package\",\"$BARRIER\"],[\"run_script\",\"touch\",\"$PASSED\"]],1000]]}" ||
		! ubus call service event "{\"type\":\"config.change\",\"data\":{\"package\":\"$BARRIER\"}}"; then
		sleep $BLIND_S
		return 0
	fi
	until_s $BARRIER_LIMIT_S [ -e "$PASSED" ]
	passed=$?
	ubus call service delete "{\"name\":\"$BARRIER\"}"
	rm -f "$PASSED"
	return $passed
}

# netifd reads /lib/netifd/proto once, when it starts (proto_shell_init, 19.07 to 25.12): where the package came later,
# it does not know batman-adv, and a reload leaves bat0 unmade.
learn_batman_adv() {
	grep -q batadv /etc/config/network && known=$(ubus call network get_proto_handlers 2>/dev/null) || return 0
	case $known in *'"batadv"'*) ;; *) /etc/init.d/network restart || fail "restart of network" ;; esac
}

# take_up: sends the events. reload_config knows the packages that it has seen before (/var/run/config.md5), and sends
# none for a file that is new; procd merges an event that comes twice.
take_up() {
	reload_config || fail reload_config
	for package in $PACKAGES; do
		ubus call service event "{\"type\":\"config.change\",\"data\":{\"package\":\"$package\"}}"
	done
	barrier || fail "procd did not run the reloads within $BARRIER_LIMIT_S s"
}

netifd_is_idle() {
	! { ubus call network.wireless status && ubus call network.interface dump; } 2>/dev/null | grep -q '"pending": true'
}

# radio_interfaces: those of enabled radios and sections that have a name, one `+NAME` each, and one `-NAME` for each
# other one; sections without a name are left out.
radio_interfaces() {
	uci -q show wireless | awk -F"[.=]" '
		{ value = $0; sub(/^[^=]*=/, "", value); gsub(/\047/, "", value) }
		NF == 3 && value == "wifi-iface" { sections[++count] = $2 }
		NF > 3 { options[$2, $3] = value }
		END {
			for (i = 1; i <= count; i++) {
				section = sections[i]
				if (options[section, "ifname"] == "") continue
				off = options[section, "disabled"] == "1" || options[options[section, "device"], "disabled"] == "1"
				print (off ? "-" : "+") options[section, "ifname"]
			}
		}'
}

# no_radio_is_lost: none that is configured has gone since the reload began, and none that is off has stayed. One that was
# missing all along is none of ours: a USB radio that is not plugged in, a first set-up that takes its time.
no_radio_is_lost() {
	for interface in $(radio_interfaces); do
		name=${interface#?}
		case $interface in
		+*) case $before_interfaces in *" $name "*) [ -e "/sys/class/net/$name" ] || return 1 ;; esac ;;
		-*) [ ! -e "/sys/class/net/$name" ] || return 1 ;;
		esac
	done
}

# settle_radios: waits until they are set up. 25.12 leaves the interface of a radio that was disabled, and removes the
# one it has just created when it moves from wpa_supplicant back to an open cell (wifi-scripts: mac80211.sh, wdev.uc);
# to take the radios down first clears what it remembers.
settle_radios() {
	until_s $NETIFD_LIMIT_S netifd_is_idle
	until_s $RADIO_LIMIT_S no_radio_is_lost && return
	[ -x /sbin/wifi ] || return 0
	/sbin/wifi down
	/sbin/wifi up
	until_s $NETIFD_LIMIT_S netifd_is_idle
}

is_firewall_running() { [ -e /var/run/fw4.state ] || [ -e /var/run/fw3.state ]; }

# The rules are new, and so are their handles, with every ruleset that nft accepted.
rules_of_fw4() { nft -a list chain inet fw4 input 2>/dev/null | md5sum; }

# load_firewall: loads the ruleset and sees it in force. fw4 ends with 0 and writes its state file also where nft refused
# the ruleset (firewall4: root/sbin/fw4), so the rules that are loaded count; fw3 tells by its exit status. Without its
# state file fw4 does not reload at all, and has to be started. A reload by hotplug beside it is waited for by their lock.
load_firewall() {
	[ -x /etc/init.d/firewall ] && /etc/init.d/firewall enabled || return 0
	verb=reload
	is_firewall_running || verb=start
	before=$(rules_of_fw4)
	/etc/init.d/firewall $verb
	ended=$?
	if command -v fw4 >/dev/null && command -v nft >/dev/null; then
		[ "$(rules_of_fw4)" != "$before" ]
	else
		return $ended
	fi
}

dropbear_service() { ubus call service list '{"name":"dropbear"}' 2>/dev/null; }

without_pids() { echo "$1" | sed '/"pid":/d'; }

pids_in() { echo "$1" | sed -n 's/.*"pid": *\([0-9]*\).*/\1/p'; }

# dropbear_is_new: no process of before runs with options of before. procd lists the new command at once and starts it
# when the old process has ended.
dropbear_is_new() {
	now_dropbear=$(dropbear_service)
	[ "$(without_pids "$now_dropbear")" != "$(without_pids "$before_dropbear")" ] || return 0
	for pid in $(pids_in "$before_dropbear"); do
		! kill -0 "$pid" 2>/dev/null || return 1
	done
}

mkdir -p /tmp/meshctl
before_dropbear=$(dropbear_service)
before_interfaces=" $(cd /sys/class/net && echo *) "
[ -z "$PACKAGES" ] || take_up
if changed network wireless; then
	learn_batman_adv
	settle_radios
fi
if changed network; then
	# bat0 that was created again knows no station behind it and announces the node's own address only once it has sent
	# something through it. Where br-lan has other ports nothing makes it do so, because its link never went down, and
	# loop avoidance holds broadcasts for half a minute, but not unicast. So the node sends to the address that it was
	# last reached from, once a second, until bat0 is there for certain.
	[ -z "$SSH_CONNECTION" ] || ping -c "$SPEAK_FRAMES" "${SSH_CONNECTION%% *}" >/dev/null 2>&1 </dev/null &
fi
for service in $SERVICES; do
	"/etc/init.d/$service" restart || fail "restart of $service"
done
if changed network; then
	# interfaces that came up trigger dropbear, and the firewall by hotplug
	barrier || fail "procd did not run the reloads within $BARRIER_LIMIT_S s"
fi
if changed network firewall; then
	load_firewall || ! changed firewall || fail "the firewall's new ruleset is not loaded"
fi
if changed network dropbear; then
	until_s $DROPBEAR_LIMIT_S dropbear_is_new || fail "dropbear still runs with its old options"
fi
exit $STATUS
