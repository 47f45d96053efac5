# Stand-in for fw3 and fw4: `uci export firewall` and the devices of the networks (NETWORK DEVICE, in the file `devices`)
# -> the rules for a new SSH connection, one per line; the first that matches decides:
#   rule DEVICE|* ADDRESS|* ACCEPT|REJECT|DROP COMMENT
# and the devices between which new connections are forwarded, within a zone and from zone to zone:
#   forward FROM TO ACCEPT COMMENT
# Rules for certain senders (src_ip, src_mac, src_port, ipset) never match.
BEGIN {
	while ((getline line < devices) > 0) { split(line, part, " "); device_of[part[1]] = device_of[part[1]] " " part[2] }
	FS = " "
}
/^config / { type = $2; id = ++sections; kind[id] = type; next }
/^\t(option|list) / {
	option = $2
	text = $0; sub(/^\t[a-z]+ [^ ]+ '/, "", text); sub(/'$/, "", text)
	if ((id, option) in opt) opt[id, option] = opt[id, option] " " text; else opt[id, option] = text
}
function get(id, option, otherwise) { return (id, option) in opt ? opt[id, option] : otherwise }
function off(id) { return get(id, "enabled", "1") ~ /^(0|off|false|no|disabled)$/ }
# the verdict as the release reads it; an invalid one is DROP
function verdict_of(text, otherwise) { text = toupper(text); return text ~ /^(ACCEPT|REJECT|DROP)$/ ? text : otherwise }
function covers_ssh(ports,    n, i, list, ends) {
	if (ports == "") return 1
	n = split(ports, list, " ")
	for (i = 1; i <= n; i++) { split(list[i], ends, /[-:]/); if (list[i] == "22" || (ends[2] != "" && ends[1] + 0 <= 22 && ends[2] + 0 >= 22)) return 1 }
	return 0
}
function each_device(zone, address, verdict, comment,    n, i, list) {
	n = split(devices_of[zone], list, " ")
	for (i = 1; i <= n; i++) print "rule\t" list[i] "\t" address "\t" verdict "\t" comment
}
END {
	# no configuration: fw4 handles it like one without zones, which drops everything
	input = "DROP"
	for (id = 1; id <= sections; id++) if (kind[id] == "defaults") input = verdict_of(get(id, "input", input), "DROP")
	for (id = 1; id <= sections; id++) if (kind[id] == "zone" && !off(id)) {
		zone = get(id, "name", "")
		n = split(get(id, "network", ""), list, " ")
		for (i = 1; i <= n; i++) devices_of[zone] = devices_of[zone] device_of[list[i]]
		devices_of[zone] = devices_of[zone] " " get(id, "device", "")
	}
	print "rule\tlo\t*\tACCEPT\tloopback"
	for (id = 1; id <= sections; id++) {
		if (kind[id] != "rule" || off(id) || get(id, "dest", "") != "" || get(id, "src", "") == "" || get(id, "family", "any") == "ipv6") continue
		if (get(id, "src_ip", "") get(id, "src_mac", "") get(id, "src_port", "") get(id, "ipset", "") != "") continue
		proto = get(id, "proto", "tcp udp")
		if (proto !~ /tcp|all|any|\*|(^| )6( |$)/ || !covers_ssh(get(id, "dest_port", ""))) continue
		verdict = verdict_of(get(id, "target", "DROP"), "")
		if (verdict == "") continue
		address = get(id, "dest_ip", "*"); sub(/\/32$/, "", address)
		if (get(id, "src", "") == "*") print "rule\t*\t" address "\t" verdict "\t" get(id, "name", "")
		else each_device(get(id, "src", ""), address, verdict, get(id, "name", ""))
	}
	for (id = 1; id <= sections; id++) if (kind[id] == "zone" && !off(id))
		each_device(get(id, "name", ""), "*", verdict_of(get(id, "input", input), "DROP"), get(id, "name", ""))
	print "rule\t*\t*\t" input "\tdefaults"
	for (id = 1; id <= sections; id++) {
		if (kind[id] == "zone" && !off(id) && verdict_of(get(id, "forward", "DROP"), "DROP") == "ACCEPT") forward(get(id, "name", ""), get(id, "name", ""))
		if (kind[id] == "forwarding" && !off(id)) forward(get(id, "src", ""), get(id, "dest", ""))
	}
}
function forward(from, to,    n, m, i, j, list, others) {
	n = split(devices_of[from], list, " "); m = split(devices_of[to], others, " ")
	for (i = 1; i <= n; i++) for (j = 1; j <= m; j++) print "forward\t" list[i] "\t" others[j] "\tACCEPT\t" from "-" to
}
