# Prints all facts of a node that meshctl uses. Sent with `N` (a nonce no output can contain), `EXTRA` (further paths),
# `BRIEF` (not empty: only what the proof of a change needs) and `NEAR` (not empty: of a long table of originators only
# the rows that describe neighbors) set before it. Each section is `N begin NAME`, the raw output of a tool, a newline,
# `N end STATUS`; after a line `N gzip`, all of it is compressed. A missing or failing tool gives an empty section with
# its status. Nothing here changes the node.

section() { # NAME COMMAND...
	printf '%s begin %s\n' "$N" "$1"
	shift
	"$@" 2>/dev/null
	STATUS=$?
	printf '\n%s end %s\n' "$N" $STATUS
}

# detail NAME COMMAND...: a section that no proof of a change needs; each costs one to three processes
detail() { [ -n "$BRIEF" ] || section "$@"; }

# first_line FILE: without a process, for the short files of the kernel
first_line() {
	line=''
	read -r line <"$1" || [ -n "$line" ] || return
	echo "$line"
}

# the mounts on /, and the archive of a flash whose first boot has not ended
root() {
	[ ! -e /sysupgrade.tgz ] || echo /sysupgrade.tgz
	while read -r device at rest; do [ "$at" != / ] || echo "$device $at $rest"; done </proc/mounts
}

macs() {
	for d in /sys/class/net/*; do
		[ ! -f "$d/address" ] || { read -r mac <"$d/address" && read -r index <"$d/ifindex" && echo "${d##*/} $mac $index"; }
	done
}

bridges() {
	for d in /sys/class/net/*/brif; do
		[ -d "$d" ] || continue
		name=${d%/brif}
		ports=''
		for port in "$d"/*; do [ ! -e "$port" ] || ports="$ports ${port##*/}"; done
		echo "${name##*/}$ports"
	done
}

load() {
	first_line /proc/loadavg || return
	count=0
	for cpu in /sys/devices/system/cpu/cpu[0-9]*; do [ ! -e "$cpu" ] || count=$((count + 1)); done
	echo $count
}

# opkg and apk are slow on a small processor, so read their databases
packages() {
	if command -v apk >/dev/null; then
		if [ -f /lib/apk/db/installed ]; then
			awk '/^P:/ { name = substr($0, 3) } /^V:/ { print name " " substr($0, 3) }' /lib/apk/db/installed
		else
			apk list --installed
		fi
	elif [ -f /usr/lib/opkg/status ]; then
		awk '/^Package:/ { name = $2 } /^Version:/ { version = $2 } /^Status:/ { installed = $NF == "installed" }
			/^$/ { if (name != "" && installed) print name " " version; name = "" }
			END { if (name != "" && installed) print name " " version }' /usr/lib/opkg/status
	else
		command -v opkg >/dev/null && opkg list-installed
	fi
}

# The radio interfaces that wpa_supplicant runs, by their control sockets. netifd's scripts delete the socket of an interface
# that they set up once more, while the supplicant goes on (hostapd.sh: wpa_supplicant_teardown_interface, up to 24.10).
# So one that netifd gave to the supplicant, by a file (hostapd.sh, 25.12: supplicant.uc), and that has no socket is looked
# for on the bus. `ubus list` ends with 4 where nothing matches; that is no failure.
supplicants() {
	for socket in /var/run/wpa_supplicant/*; do [ ! -e "$socket" ] || echo "${socket##*/}"; done
	for file in /var/run/wpa[_-]supplicant-*.conf; do
		name=${file#/var/run/wpa?supplicant-}
		[ -e "$file" ] && [ ! -e "/var/run/wpa_supplicant/${name%.conf}" ] || continue
		ubus list 'wpa_supplicant.*'
		break
	done
	return 0
}

listed_radios() {
	[ -z "$radios" ] || echo "$radios"
	return $known
}

listed_configuration() {
	[ -r /etc/config ] || return
	for conf in /etc/config/*; do echo "${conf##*/}"; done
}

# The packages that rpcd will restore because LuCI has applied a change that nobody has confirmed yet. A snapshot alone is no
# sign (deadman.sh: rpcd_waits); without one, which is the rule, this is no process.
unconfirmed() {
	names=''
	for file in /var/run/rpcd/snapshot-files/*; do [ ! -e "$file" ] || names="$names ${file##*/}"; done
	[ -n "$names" ] || return 0
	case $(ubus -t 5 call uci confirm '{"ubus_rpc_session":"meshctl"}' 2>&1) in
	*'No response'* | *'Not found'*) return 0 ;;
	esac
	echo "$names"
}

package_tool() { command -v apk || command -v opkg; }

# the channel in use alone: some drivers list every channel of the band
survey() { # INTERFACE
	iw dev "$1" survey dump | awk '/^Survey/ { head = $0 } /frequency:/ { used = /\[in use\]/; if (used) print head } used && !/^Survey/'
}

# packets queued per radio (debugfs), temperatures in thousandths of a degree; a file that is missing is left out
sensors() {
	grep -sHE '^-?[0-9]+$|fq_backlog' /sys/kernel/debug/ieee80211/phy*/aqm /sys/class/thermal/thermal_zone*/temp \
		/sys/class/ieee80211/phy*/hwmon*/temp1_input /sys/class/ieee80211/phy*/device/hwmon/hwmon*/temp1_input
}

# each radio: its number, its place in the kernel's device tree, written as UCI's `path` (mac80211_phy_to_path), its driver
phys() (
	for phy in /sys/class/ieee80211/*; do
		read -r number <"$phy/index" && cd -P "$phy/device" || continue
		path=${PWD#/sys/devices/}
		case $path in platform*/pci*) path=${path#platform/} ;; esac
		# several radios of one device: all after the first have a number
		count=0
		for sibling in ieee80211/*; do
			[ "${sibling##*/}" != "${phy##*/}" ] || break
			count=$((count + 1))
		done
		[ ! -e "$sibling" ] || [ $count -eq 0 ] || path=$path+$count
		driver=''
		! cd -P driver || driver=${PWD##*/}
		echo "phy$number $path $driver"
	done
)

# what each radio can do: its modes and channels, of the several hundred lines that iw prints
abilities() {
	iw phy | awk '/^Wiphy |^\twiphy index:/ { print; next }
		/^\t[^\t]/ { modes = /Supported interface modes:/; if (modes) print; next }
		modes || /^\t\t\t\* [0-9.]+ MHz \[/'
}

# contents NAME FILE...: a section for each file, all from one process: starting one takes a small processor longer than
# printing them. A file is one record to awk, and its last line ends as it does there.
contents() {
	awk -v N="$N" 'BEGIN {
		RS = "\001"
		for (i = 1; i < ARGC; i += 2) {
			printf "%s begin %s\n", N, ARGV[i]
			for (count = 0; (got = (getline record <ARGV[i + 1])) > 0; count++) printf "%s%s", count ? RS : "", record
			printf "\n%s end %d\n", N, (got < 0)
		}
	}' "$@"
}

host_keys() { for key in /etc/dropbear/dropbear_*_host_key; do [ ! -f "$key" ] || dropbearkey -y -f "$key"; done; }

# entries of the global translation table by type: counted here, since the table of a large mesh is long
transglobal() { # meshif|-m INTERFACE
	entries=$(batctl "$1" "$2" transglobal -H -n) || return
	awk '
		{ mac = $1 ~ /:/ ? $1 : $2 }
		mac ~ /^[0-9a-f][13579bdf]:/ { multicast++ }
		mac ~ /^[0-9a-f][02468ace]:/ { unicast++ }
		END { printf "unicast %d\nmulticast %d\n", unicast, multicast }' <<-END
		$entries
	END
}

# batctl prints JSON from 2021.1 on; older ones print tables
# Each node of a large mesh has several paths to every other one: several kilobytes, even compressed, of a channel that
# all share. The rows of a neighbor are its own, or all paths through it where none is.
originators() { # INTERFACE
	COUNTS=''
	rows=$(batctl meshif "$1" originators_json) || return
	if [ -n "$NEAR" ] && [ ${#rows} -gt 8192 ]; then
		near=$(printf '%s\n' "$rows" | near_originators) && COUNTS=${near%%"["*} && rows=${near#"$COUNTS"}
	fi
	printf '%s\n' "$rows"
}

# near_originators: "SELECTED OTHER [ROWS]", or a failure if the table is not written as expected
near_originators() {
	awk '
		BEGIN { RS = "}" }
		!/"orig_address"/ { next }
		{
			at = index($0, "\"orig_address\":\"")
			mac = substr($0, at + 16, 17)
			by = index($0, "\"neigh_address\":\"")
			if (!at || !by) exit (bad = 1)
			hop[++count] = substr($0, by + 17, 17)
			row[count] = substr($0, index($0, "{"))
			if (mac == hop[count]) own[count] = direct[mac] = 1
			if (index($0, "\"best\":true")) selected++
		}
		END {
			if (bad || !count) exit 1
			printf "%d %d [", selected, count - selected
			for (n = 1; n <= count; n++) {
				if ((n in own) || !(hop[n] in direct)) {
					printf "%s%s}", comma, row[n]
					comma = ","
				}
			}
			print "]"
		}'
}

mesh() { # INTERFACE
	section "batctl.mesh_json $1" batctl meshif "$1" mesh_json
	section "batctl.hardifs_json $1" batctl meshif "$1" hardifs_json
	section "batctl.neighbors_json $1" batctl meshif "$1" neighbors_json
	section "batctl.originators_json $1" originators "$1"
	if [ $STATUS -eq 0 ]; then
		[ -z "$COUNTS" ] || section "batctl.originators_count $1" echo "$COUNTS"
		detail "batctl.statistics $1" batctl meshif "$1" statistics
		detail "batctl.transglobal $1" transglobal meshif "$1"
		return
	fi
	detail "batctl.statistics $1" batctl -m "$1" statistics
	detail "batctl.transglobal $1" transglobal -m "$1"
	section "batctl.interface $1" batctl -m "$1" if
	section "batctl.neighbors $1" batctl -m "$1" n
	section "batctl.originators $1" batctl -m "$1" o
}

report() {
	section uptime first_line /proc/uptime
	detail clock date +%s
	section boot_id first_line /proc/sys/kernel/random/boot_id
	section ubus.board ubus call system board
	section board_name first_line /tmp/sysinfo/board_name
	section model first_line /tmp/sysinfo/model
	section load load
	detail df df -k / /tmp
	section root root
	section macs macs
	section ubus.wireless ubus call network.wireless status
	section ubus.interfaces ubus call network.interface dump
	# all interfaces are listed before the first is asked: the list is in memory
	radios=$(iw dev 2>/dev/null)
	known=$?
	section iw.dev listed_radios
	while read -r word dev _; do
		[ "$word" = Interface ] || continue
		section "iw.link $dev" iw dev "$dev" link </dev/null
		section "iw.stations $dev" iw dev "$dev" station dump </dev/null
		detail "iw.survey $dev" survey "$dev" </dev/null
	done <<-END
		$radios
	END
	for dev in /sys/class/net/bat*; do
		[ ! -e "$dev" ] || mesh "${dev##*/}"
	done
	detail sensors sensors
	detail phys phys
	detail iw.phy abilities
	section supplicants supplicants
	section bridges bridges
	[ ! -e /etc/meshctl/lan-filter.sh ] || section lan_filter nft list table bridge meshctl_lan
	section package_tool package_tool
	section packages packages
	detail uci.changes uci changes
	[ ! -d /var/run/rpcd/snapshot-files ] || detail uci.unconfirmed unconfirmed
	section config.list listed_configuration
	set -- openwrt_release /etc/openwrt_release board.json /etc/board.json meminfo /proc/meminfo
	for conf in /etc/config/*; do
		[ ! -f "$conf" ] || set -- "$@" "config ${conf##*/}" "$conf"
	done
	if [ -f /etc/dropbear/authorized_keys ]; then
		set -- "$@" authorized_keys /etc/dropbear/authorized_keys
	else
		section authorized_keys true
	fi
	contents "$@"
	detail host_keys host_keys
	for path in $EXTRA; do
		section "mode $path" ls -lnd "$path"
		[ ! -f "$path" ] || section "hash $path" sha256sum "$path"
		# enough for any configuration; of a larger file only the hash counts
		[ ! -f "$path" ] || section "text $path" head -c 65536 "$path"
	done
	if [ -x /usr/sbin/meshctl-deadman ]; then
		section deadman /usr/sbin/meshctl-deadman status
	else
		section deadman echo absent
	fi
	section done true
}

# The tables of a large mesh are long and repeat themselves: compressed, those of a node among 220 are less than a tenth. A
# short answer is sent as it is, without two more processes.
if [ -z "$BRIEF" ] && command -v gzip >/dev/null; then
	echo "$N gzip"
	report | gzip -c
else
	report
fi
