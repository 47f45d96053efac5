# Stand-in for netifd on real radios, the model: after netifd.awk, the kernel's target state -> run/kernel.new.
#
# One line per device, port or address, tab-separated, in the order of creation. A line ends with the lines it depends on:
# when a radio or bat0 is recreated, so is what depends on it. MAKING counts how often netifd.awk recreated the interface;
# settings that this release changes in place have a line of their own, and so has the country, which all radios share.
#
#   bridge NAME MAC
#   soft   NAME ALGORITHM OPTIONS MAC
#   radio  NAME NUMBER MODE MHZ WIDTH SSID BSSID MCAST_KBPS MAKING MAC BEACON_TU - - ALGORITHM KEY FORWARDING
#   tune   NAME NUMBER DBM DISTANCE_M
#   hard   NAME MASTER MTU OPTIONS
#   port   BRIDGE NAME
#   addr   DEVICE ADDRESS/PREFIX
#   route  DEVICE TARGET/PREFIX GATEWAY

function field(value) { return "\t" (value == "" ? "-" : value) }

# OPTION=VALUE of the set options, separated by blanks
function chosen(id, wanted,    n, i, list, text) {
	n = split(wanted, list, " ")
	for (i = 1; i <= n; i++) if ((id, list[i]) in opt) text = text (text == "" ? "" : " ") list[i] "=" opt[id, list[i]]
	return text
}

function add(name, line) { made_of[name] = line; plan = plan line "\n" }

# without tabs, to separate a line's own fields from those of its dependencies
function standing_on(name,    text) { text = made_of[name]; gsub(/\t/, "|", text); return field(text) }

function plan_radios(    i, id, device, ifname, path, country) {
	for (i = 1; i <= sections; i++) {
		id = order[i]
		if (!(id in iface_name)) continue
		ifname = iface_name[id]
		if (!(ifname in cell)) continue
		device = get(id, "device", ""); path = radio_path[device]
		split(cell[ifname], part, "\t")
		if ((country = get(id_of(device), "country", "")) != "") plan = plan "reg" field(country) "\n"
		add(ifname, "radio" field(ifname) field(phy_of[path]) field(get(id, "mode", "")) field(part[4]) \
			field(get(id_of(device), "htmode", "NOHT")) field(part[5]) field(part[6]) field(get(id, "mcast_rate", "")) \
			field(index_of[ifname]) field(mac[ifname]) field(get(id_of(device), "beacon_int", "100")) \
			field("") field("") field(part[7]) field(part[8]) field(yes(get(id, "mesh_fwding", "1")) ? 1 : 0))
		plan = plan "tune" field(ifname) field(phy_of[path]) field(power(device, path)) field(get(id_of(device), "distance", "")) standing_on(ifname) "\n"
	}
}

function plan_batman(    i, id, name) {
	for (i = 1; i <= sections; i++) {
		id = order[i]; name = label[id]
		if (kind[id] == "network.interface" && get(id, "proto", "") == "batadv" && name in is_soft)
			add(name, "soft" field(name) field(algorithm[name]) field(chosen(id, "aggregated_ogms ap_isolation bonding " \
				"bridge_loop_avoidance distributed_arp_table fragmentation gw_mode hop_penalty multicast_mode " \
				"multicast_fanout orig_interval")) field(set_mac(name)))
	}
}

function plan_hard(    i, j, id, ifname) {
	for (i = 1; i <= sections; i++) {
		id = order[i]
		if (kind[id] != "network.interface" || get(id, "proto", "") != "batadv_hardif") continue
		for (ifname in master) if (network_of[ifname] == label[id] || ifname == get(id, "device", get(id, "ifname", "")))
			add("hard " ifname, "hard" field(ifname) field(master[ifname]) field(mtu[ifname]) \
				field(chosen(id, "elp_interval hop_penalty throughput_override")) standing_on(ifname) standing_on(master[ifname]))
	}
}

function plan_bridges(    name, n, i, list) {
	for (name in is_bridge) add(name, "bridge" field(name) field(lan_mac))
	for (name in is_bridge) {
		n = split(bridge_ports[name], list, " ")
		for (i = 1; i <= n; i++) plan = plan "port" field(name) field(list[i]) standing_on(list[i]) "\n"
	}
}

# on bat0 they go with it when it is recreated
function plan_addresses(    line, part) {
	close(run "/addresses.new")
	while ((getline line < (run "/addresses.new")) > 0) {
		split(line, part, " ")
		plan = plan "addr" field(part[1]) field(part[2]) standing_on(part[1]) "\n"
	}
}

function plan_routes(    n, i, list, part) {
	n = split(effective, list, "\n")
	for (i = 1; i <= n; i++) if (split(list[i], part, "\t") && part[1] == "route")
		plan = plan "route" field(part[2]) field(part[3] "/" part[4]) field(part[5]) standing_on(part[2]) "\n"
}

END {
	if (mode != "down") {
		plan_batman()
		plan_radios()
		plan_bridges()
		plan_hard()
		plan_addresses()
		plan_routes()
	}
	printf "%s", plan > (run "/kernel.new")
}
