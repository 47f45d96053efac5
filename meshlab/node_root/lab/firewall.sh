# Shared by the stand-ins of fw3 and fw4. $LOADED has the loaded rules (format: lab/firewall_rules.awk).
RUN=/tmp/run/firewall
LOADED=$RUN/loaded
mkdir -p $RUN
umask 022

# take MS [MORE]: sleep MS plus up to MORE; not while the node boots, because a real boot takes many times as long
take() {
	[ -f /tmp/run/procd/booted ] || return 0
	. /lab/node/board
	draw "${2:-0}"
	/rom/lab/genuine/busybox usleep $((($1 + draw) * 1000 * SLOWNESS))
}
# the current device of each network
devices_now() {
	ubus call network.interface dump 2>/dev/null | awk -F '"' '
		$2 == "interface" && NF > 4 { name = $4; device = "" }
		$2 == "device" { device = $4 }
		$2 == "l3_device" { l3 = $4 }
		/^\t\t\}/ { if (l3 device != "") print name, (l3 != "" ? l3 : device); name = device = l3 = "" }' >$RUN/devices
}
read_rules() { uci -q export firewall 2>/dev/null | awk -v devices=$RUN/devices -f /rom/lab/firewall_rules.awk >$LOADED.new; }
# a load flushes the table's rules and adds new ones: handles grow as long as the table exists
put_rules() {
	read -r handle 2>/dev/null <$RUN/handle || handle=36
	awk -v handle="$handle" 'BEGIN { OFS = "\t" } { print $0, handle + 2 + NR }' $LOADED.new >$LOADED.handles
	echo $((handle + 50 + $(wc -l <$LOADED.new))) >$RUN/handle
	mv -f $LOADED.handles $LOADED
}
# run_includes: the administrator's scripts, which the firewall sources after its own rules
run_includes() {
	for path in $(uci -q show firewall | sed -n "s/^firewall\.[^.]*\.path='\(.*\)'$/\1/p"); do
		[ ! -f "$path" ] || (. "$path")
	done
}
no_rules() {
	: >$LOADED
	rm -f $RUN/handle
	sh /rom/lab/report_interfaces
}
shown_rules() { # [HANDLES]: as nft lists the input chain
	awk -F '\t' -v handles="$1" '
		function told(text, handle) { print text (handles ? " # handle " handle : "") }
		BEGIN {
			told("table inet fw4 {", 1)
			told("\tchain input {", 1)
			print "\t\ttype filter hook input priority filter; policy drop;"
		}
		$1 == "forward" { next }
		NR == 1 {
			told("\t\tiif \"lo\" accept comment \"!fw4: Accept traffic from loopback\"", $6 - 1)
			told("\t\tct state vmap { established : accept, related : accept } comment \"!fw4: Handle inbound flows\"", $6)
			next
		}
		{ told("\t\t" ($2 == "*" ? "" : "iifname \"" $2 "\" ") ($3 == "*" ? "" : "ip daddr " $3 " ") tolower($4) " comment \"!fw4: " $5 "\"", $6) }
		END { print "\t}\n}" }'
}
zone_of() { # network|device|zone NAME: the zone's name; 1 when there is none
	uci -q export firewall | awk -v what="$1" -v wanted="$2" '
		function close_() { if (zone && ((what == "zone" && name == wanted) || (what != "zone" && index(" " of[what] " ", " " wanted " ")))) { print name; found = 1; exit } }
		/^config / { close_(); zone = $2 == "zone"; name = ""; split("", of) }
		/^\t/ { gsub(/\047/, ""); if ($2 == "name") name = $3; if ($2 == "network" || $2 == "device") for (i = 3; i <= NF; i++) of[$2] = of[$2] " " $i }
		END { if (!found) close_(); exit !found }'
}
