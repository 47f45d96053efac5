# A change's reload: reloads the services of changed files and waits until all effects on logins are in force. Sent with
# PACKAGES (changed UCI packages), SERVICES (services to restart, by name) and SPEAK_FRAMES set before it. Exits with 0
# if every effect was observed, with 75 if the confirm window was too short for that, with 1 if something failed.
#
#   reload_config -> procd has run the triggered scripts (`barrier`) -> netifd has set up interfaces and radios
#   (`settle_radios`), which are part of batman-adv again (`settle_mesh`) -> procd has run the scripts triggered by
#   interfaces -> the firewall is loaded (`load_firewall`) -> dropbear runs with its new options (`dropbear_is_new`)
#
# reload_config only sends events and always exits with 0. procd waits 1 s, then runs the init scripts in sequence and
# discards their exit status (procd: service/trigger.c, the same from 19.07 to 25.12).
#
# named by process id, because a rollback may start while the reload of its change is still running
BARRIER=meshctl-barrier-$$
BARRIERS=/tmp/meshctl/meshctl-barrier
MEMBERS=/tmp/meshctl/reload.members
#
# The limits are for what hangs, not for what is slow: a change's waits end with its window (is_late), and a reload after a
# rollback that fails reboots the node, which takes a slow one longer than to wait. deadman.sh ends that after 300 s.
BARRIER_LIMIT_S=240  # all reloads in sequence; 10 s on an idle 400 MHz processor, minutes if it also formats flash or makes keys
BLIND_S=10           # if procd rejects our trigger: about the time its reloads take
SETUP_LIMIT_S=60     # netifd kills a setup that takes more than 30 s, and tries again
NETIFD_LIMIT_S=20    # a WAN without a server takes longer; the health checks cover what matters
RADIO_LIMIT_S=15     # netifd may not have started, or the radio is between down and up
MESH_LIMIT_S=30      # a process of netifd per interface
DROPBEAR_LIMIT_S=30  # procd waits 5 s for the old process before it kills it
STATUS=0
NEWLINE='
'

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

# is_late: whether the uptime UNTIL_S has come, shortly before the change is rolled back; a rollback's own reload has none
is_late() { [ -n "$UNTIL_S" ] && read -r uptime _ </proc/uptime && [ "${uptime%.*}" -ge "$UNTIL_S" ]; }

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

# until_s SECONDS COMMAND...: runs COMMAND once a second until it succeeds; 1 on timeout, or when it is late
until_s() {
	seconds=$1
	shift
	until "$@"; do
		[ "$seconds" -gt 0 ] && ! is_late || return 1
		seconds=$((seconds - 1))
		pause 1
	done
}

# barrier: returns once procd has run every script triggered before it. procd delays each trigger and queues the scripts
# in the order in which their delays end, so ours, triggered last with the same delay, runs last.
barrier() {
	# a directory, in which a `touch` that procd runs after this script's end makes nothing
	mkdir -p "$BARRIERS-$$"
	if ! ubus call service set "{\"name\":\"$BARRIER\",\"triggers\":[[\"config.change\",[\"if\",[\"eq\",\"package\",\"$BARRIER\"],[\"run_script\",\"touch\",\"$BARRIERS-$$/passed\"]],1000]]}" ||
		! ubus call service event "{\"type\":\"config.change\",\"data\":{\"package\":\"$BARRIER\"}}"; then
		pause $BLIND_S
		end_barrier $$
		return 0
	fi
	until_s $BARRIER_LIMIT_S [ -e "$BARRIERS-$$/passed" ]
	passed=$?
	end_barrier $$
	return $passed
}

end_barrier() { # PID: of its script
	ubus call service delete "{\"name\":\"meshctl-barrier-$1\"}"
	rm -rf "$BARRIERS-$1"
}

# end_stopped_barriers: those of reloads that were stopped, as by a rollback
end_stopped_barriers() {
	for stopped in "$BARRIERS"-*; do
		[ ! -d "$stopped" ] || kill -0 "${stopped##*-}" 2>/dev/null || end_barrier "${stopped##*-}"
	done
}

# netifd reads /lib/netifd/proto only when it starts (proto_shell_init, 19.07 to 25.12). If the package was installed
# later, netifd does not know batman-adv, and a reload does not create bat0.
learn_batman_adv() {
	grep -q batadv /etc/config/network && known=$(ubus call network get_proto_handlers 2>/dev/null) || return 0
	case $known in *'"batadv"'*) ;; *) /etc/init.d/network restart || fail "restart of network" ;; esac
}

# take_up: sends the events. reload_config sends none for a new file, only for packages it has seen before
# (/var/run/config.md5); procd merges duplicate events.
take_up() {
	reload_config || fail reload_config
	for package in $PACKAGES; do
		ubus call service event "{\"type\":\"config.change\",\"data\":{\"package\":\"$package\"}}"
	done
	barrier || fail "procd did not run the reloads in time"
}

is_pending() { # OBJECT METHOD: of netifd
	case $(ubus call "$1" "$2" 2>/dev/null) in *'"pending": true'*) ;; *) return 1 ;; esac
}

radios_are_set_up() { ! is_pending network.wireless status; }

interfaces_are_set_up() { ! is_pending network.interface dump; }

# await_netifd: radios first, since the interfaces on them follow
await_netifd() {
	until_s $SETUP_LIMIT_S radios_are_set_up
	until_s $NETIFD_LIMIT_S interfaces_are_set_up
}

# radio_interfaces: prints `+NAME` for each enabled radio interface and `-NAME` for each disabled one; `+` for an enabled
# one without an ifname; `:NAME` for each disabled radio; `=NAME` for each enabled one whose network is batman-adv's.
radio_interfaces() {
	{ uci -q show network; uci -q show wireless; } | awk -F"[.=]" '
		{ value = $0; sub(/^[^=]*=/, "", value); gsub(/\047/, "", value) }
		$1 == "network" { if ($3 == "proto" && value == "batadv_hardif") hard[$2]; next }
		NF == 3 && value == "wifi-iface" { sections[++count] = $2 }
		NF == 3 && value == "wifi-device" { radios[$2] }
		NF > 3 { options[$2, $3] = value }
		END {
			for (i = 1; i <= count; i++) {
				section = sections[i]
				off = options[section, "disabled"] == "1" || options[options[section, "device"], "disabled"] == "1"
				if (!off || options[section, "ifname"] != "") print (off ? "-" : "+") options[section, "ifname"]
				if (!off && options[section, "ifname"] != "" && options[section, "network"] in hard) print "=" options[section, "ifname"]
			}
			for (radio in radios) if (options[radio, "disabled"] == "1") print ":" radio
		}'
}

# left_over: prints `-NAME` for each mesh interface of a section that is gone. With an enabled section without an ifname it
# is not known whose they are.
left_over() {
	case $NEWLINE$configured_interfaces$NEWLINE in *"$NEWLINE+$NEWLINE"*) return ;; esac
	iw dev 2>/dev/null | while read -r word value _; do
		case "$word $value" in
		'Interface '*) name=$value ;;
		'type IBSS' | 'type mesh')
			case $NEWLINE$configured_interfaces$NEWLINE in *"$NEWLINE"[+-]"$name$NEWLINE"*) ;; *) echo "-$name" ;; esac
			;;
		esac
	done
}

# no_radio_is_lost: no enabled interface has disappeared since the reload started, and no disabled one exists. One that
# was missing before does not count: a USB radio that is not plugged in, or a slow first setup.
no_radio_is_lost() {
	for interface in $configured_interfaces; do
		name=${interface#?}
		case $interface in
		+*) case $before_interfaces in *" $name "*) [ -e "/sys/class/net/$name" ] || return 1 ;; esac ;;
		-*) [ ! -e "/sys/class/net/$name" ] || return 1 ;;
		esac
	done
}

# stay_settled: looks again a second later. A change that reaches a radio while it is being set up is only noted; between
# the end of that setup and the next one, the radio is up for a moment (25.12: wireless-device.uc, wdev_setup_cb).
stay_settled() {
	is_late || pause 1
	await_netifd
	until_s $RADIO_LIMIT_S no_radio_is_lost
}

# clear_disabled_radios: takes the disabled radios down, which clears what they left on the air, and leaves the others alone
clear_disabled_radios() {
	case $configured_interfaces in *:*) ;; *) return 1 ;; esac
	for radio in $configured_interfaces; do
		case $radio in :*) /sbin/wifi down "${radio#:}" && /sbin/wifi up "${radio#:}" ;; esac
	done
	await_netifd
	until_s $RADIO_LIMIT_S no_radio_is_lost
}

# settle_radios: waits until the radios are set up. 25.12 leaves the interface of a radio in its cell when the radio is
# turned off, or the interface's section is gone, and removes the one that it has just created when a radio changes from
# wpa_supplicant to an open cell (wifi-scripts: mac80211.sh, wdev.uc). Taking the radios down first clears that state.
settle_radios() {
	await_netifd
	configured_interfaces=$(radio_interfaces)
	configured_interfaces=$configured_interfaces$NEWLINE$(left_over)
	until_s $RADIO_LIMIT_S no_radio_is_lost && stay_settled && return
	[ -x /sbin/wifi ] || return 0
	clear_disabled_radios && return
	/sbin/wifi down
	/sbin/wifi up
	await_netifd
}

# no_member_is_lost: each radio interface that has joined its cell is part of batman-adv, and so is each that was before the
# change, unless it is still joining
no_member_is_lost() {
	for interface in $configured_interfaces; do
		name=${interface#=}
		[ "$name" != "$interface" ] && [ ! -e "/sys/class/net/$name/master" ] || continue
		# it has none before it has joined, and cannot be read while the interface is down or gone
		carrier=''
		read -r carrier 2>/dev/null <"/sys/class/net/$name/carrier"
		case $carrier in
		0) ;;
		1) return 1 ;;
		*) case $members in *" $name "*) return 1 ;; esac ;;
		esac
	done
}

# settle_mesh: waits until the radio interfaces are part of batman-adv. If a radio is set up again while its last setup is
# still being torn down, as after a change whose reload the rollback has stopped, netifd may lose the interface (seen on
# 25.12.5): it is in its cell, `available`, neither `up` nor `pending`, and no reload, `ifup` or `wifi` brings it back to
# bat0, only another netifd.
settle_mesh() {
	until_s $MESH_LIMIT_S no_member_is_lost && return
	! is_late || return
	/etc/init.d/network restart || fail "restart of network"
	await_netifd
	until_s $MESH_LIMIT_S no_member_is_lost || fail "a radio is not part of batman-adv"
}

# remember_members: sets `members`, the interfaces that were part of something before the change. Its reload writes them down
# for that of the rollback, before which they may be gone.
remember_members() {
	members=' '
	for interface in /sys/class/net/*/master; do
		interface=${interface%/master}
		members="$members${interface##*/} "
	done
	if [ -n "$UNTIL_S" ]; then
		echo "$members" >"$MEMBERS"
	elif [ -e "$MEMBERS" ]; then
		read -r members <"$MEMBERS"
		members=" $members "
		rm -f "$MEMBERS"
	fi 2>/dev/null
}

is_firewall_running() { [ -e /var/run/fw4.state ] || [ -e /var/run/fw3.state ]; }

# is_firewall_enabled: what `/etc/init.d/firewall enabled` tests (rc.common), without its interpreter and libraries
is_firewall_enabled() {
	for link in /etc/rc.d/S[0-9][0-9]firewall; do [ ! -x "$link" ] || return 0; done
	return 1
}

# load_firewall: loads the ruleset and verifies it. fw4 exits with 0 and writes its state file even if nft rejected the
# ruleset (firewall4: root/sbin/fw4), so the loaded rules are compared; fw3 reports by its exit status. Without its state
# file fw4 does not reload and has to be started. The firewall's lock waits for a concurrent reload by hotplug. The init
# script's `reload` runs nothing but `fw4 reload`, and starts twice as many processes to get there.
load_firewall() {
	[ -x /etc/init.d/firewall ] && is_firewall_enabled || return 0
	verb=reload
	is_firewall_running || verb=start
	# every ruleset that nft accepts has new rules with new handles
	before=$(nft -a list chain inet fw4 input 2>/dev/null)
	if [ $verb = reload ] && command -v fw4 >/dev/null; then fw4 reload; else /etc/init.d/firewall $verb; fi
	ended=$?
	if command -v fw4 >/dev/null && command -v nft >/dev/null; then
		[ "$(nft -a list chain inet fw4 input 2>/dev/null)" != "$before" ]
	else
		return $ended
	fi
}

# drop_lan_filter: the firewall's include loads the table, but nothing unloads that of a configuration without the include
drop_lan_filter() { uci -q get firewall.lan_filter >/dev/null || nft delete table bridge meshctl_lan 2>/dev/null; }

# split_service JSON: WITHOUT_PIDS are its lines but those with a pid, PIDS these
split_service() {
	WITHOUT_PIDS='' PIDS=''
	while read -r line; do
		case $line in
		*'"pid":'*)
			line=${line##*'"pid":'}
			line=${line# }
			PIDS="$PIDS ${line%%[!0-9]*}"
			;;
		*) WITHOUT_PIDS=$WITHOUT_PIDS$NEWLINE$line ;;
		esac
	done <<-END
		$1
	END
}

# dropbear_is_new: no old process runs with old options. procd lists the new command at once and starts it when the old
# process has ended.
dropbear_is_new() {
	split_service "$(ubus call service list '{"name":"dropbear"}' 2>/dev/null)"
	[ "$WITHOUT_PIDS" != "$before_options" ] || return 0
	for pid in $before_pids; do
		! kill -0 "$pid" 2>/dev/null || return 1
	done
}

# resolve_without_dnsmasq: dnsmasq's script makes /tmp/resolv.conf name 127.0.0.1 and undoes that only for the sections it
# still finds. Without any, nothing would resolve names until the next boot, not even those of time servers.
resolve_without_dnsmasq() {
	grep -q '^nameserver 127\.0\.0\.1$' /tmp/resolv.conf 2>/dev/null || return 0
	! uci -q show dhcp | grep -q '=dnsmasq$' || return 0
	for servers in /tmp/resolv.conf.d/resolv.conf.auto /tmp/resolv.conf.auto; do
		[ ! -e "$servers" ] || { ln -sf "$servers" /tmp/resolv.conf && return; }
	done
}

[ -d /tmp/meshctl ] || mkdir -p /tmp/meshctl
end_stopped_barriers
split_service "$(ubus call service list '{"name":"dropbear"}' 2>/dev/null)"
before_options=$WITHOUT_PIDS before_pids=$PIDS
before_interfaces=' '
for interface in /sys/class/net/*; do before_interfaces="$before_interfaces${interface##*/} "; done
remember_members
[ -z "$PACKAGES" ] || take_up
! changed dhcp || resolve_without_dnsmasq
if changed network wireless; then
	learn_batman_adv
	settle_radios
	settle_mesh
fi
if changed network; then
	# A recreated bat0 announces the node's own address only once the node has sent a frame through it. If br-lan has
	# other ports, nothing triggers that, because its link never went down; and loop avoidance holds broadcasts for half
	# a minute, but not unicast. So the node pings the address it was last reached from, once a second, until bat0 is
	# certain to be up.
	[ -z "$SSH_CONNECTION" ] || ping -c "$SPEAK_FRAMES" "${SSH_CONNECTION%% *}" >/dev/null 2>&1 </dev/null &
fi
for service in $SERVICES; do
	"/etc/init.d/$service" restart || fail "restart of $service"
done
if changed network; then
	# interfaces that come up trigger dropbear, and the firewall by hotplug
	barrier || fail "procd did not run the reloads in time"
fi
! changed firewall || drop_lan_filter
if changed network firewall; then
	load_firewall || ! changed firewall || fail "the firewall's new ruleset is not loaded"
fi
if changed network dropbear; then
	until_s $DROPBEAR_LIMIT_S dropbear_is_new || fail "dropbear still runs with its old options"
fi
# whether it failed or would have taken longer is not known then
[ $STATUS -eq 0 ] || ! is_late || STATUS=75
exit $STATUS
