# Stand-in for netifd, the model. Input: `uci export network; uci export wireless`.
#
# sections -> which radio interfaces come up -> which devices exist -> which interfaces are up
#   -> run/dump, run/wireless (JSON for ubus), run/iw, run/addresses.new, run/routes.new, run/effective, run/sys (a shell script)
#
# Setting up radios takes time, so a change has two phases. Phase 1: everything else is as configured; radios whose
# configuration differs from run/radios are pending, and their interfaces that will be recreated are gone. Phase 2: all is
# as configured, and run/radios.new has the state: lines "device NAME OPTIONS UP" and "face NAME KEY MAC IFINDEX DEVICE BY
# LAST_WDEV_KEY", where BY is wdev, supplicant or lost. A board's own MAC address is base; from 23.05 on, the replacement of an interface that still exists gets the other one (wdev.uc).

/^package / { package = $2; next }
/^config / {
	type = $2; name = $3; gsub(/'/, "", name)
	id = package "." (name == "" ? "@" (++anonymous) : name)
	order[++sections] = id; kind[id] = package "." type; label[id] = name
	next
}
/^\t(option|list) / {
	option = $2
	value = $0; sub(/^\t[a-z]+ [^ ]+ '/, "", value); sub(/'$/, "", value); gsub(/'\\''/, "'", value)
	if ((id, option) in opt) opt[id, option] = opt[id, option] " " value; else opt[id, option] = value
	if (!((id, option) in seen)) { seen[id, option] = 1; names[id] = names[id] " " option }
}

function get(id, option, otherwise) { return (id, option) in opt ? opt[id, option] : otherwise }
function yes(value) { return value ~ /^(1|on|true|yes|enabled)$/ }
# in the replacement of gsub, "\\\\&" is a backslash and what was found in every busybox; "\\" is not
function json(text) { gsub(/["\\]/, "\\\\&", text); return "\"" text "\"" }
function shell(text) { gsub(/'/, "'\\\\&'", text); return "'" text "'" }

# --- the current state, and what a change does to it --------------------------------------------------------------------

function read_standing(    line, part) {
	while ((getline line < (run "/radios")) > 0) {
		split(line, part, "\t")
		if (part[1] == "device") { was_device[part[2]] = part[3]; was_up[part[2]] = part[4] }
		else { was_key[part[2]] = part[3]; was_mac[part[2]] = part[4]; was_index[part[2]] = part[5]; was_on[part[2]] = part[6]; was_by[part[2]] = part[7]; was_wdev[part[2]] = part[8] }
	}
	close(run "/radios")
	while ((getline line < (run "/iw")) > 0) { split(line, part, "\t"); was_iw[part[1]] = line "\n" }
	close(run "/iw")
	while ((getline line < (run "/effective")) > 0) if (sub(/^cell\t/, "", line)) {
		split(line, part, "\t")
		# without master, algorithm and index
		sub(/\t[^\t]*\t[^\t]*\t[^\t]*$/, "", line)
		was_cell[part[2]] = line
	}
	close(run "/effective")
	last_index = 20
	if ((getline line < (run "/last_index")) > 0) last_index = line + 0
	close(run "/last_index")
}

# every option of a section in order, as netifd compares them up to 24.10
function all_options(id,    n, i, list, text) {
	n = split(names[id], list, " ")
	for (i = 1; i <= n; i++) text = text " " list[i] "=" opt[id, list[i]]
	gsub(/[\t\n]/, " ", text)
	return text
}

function iw_width(htmode) {
	sub(/^(VHT|HE)20$/, "HT20", htmode); sub(/^(VHT|HE)40/, "HT40", htmode)
	return htmode == "" || htmode == "NONE" ? "NOHT" : htmode
}

# from 23.05 on: the settings whose change recreates an interface (wdev.uc's object, or wpa_supplicant's file)
function own_key(id, device, by,    d, n, i, list, text) {
	d = id_of(device)
	text = by " " get(id, "mode", "ap") " " get(id, "ssid", "") get(id, "mesh_id", "") " " band(d) " " get(d, "channel", "auto") " " \
		iw_width(get(d, "htmode", "")) " " (get(id, "mode", "") == "mesh" ? "" : get(id, "bssid", "")) " " get(d, "beacon_int", "") " " \
		get(d, "basic_rate", "") " " get(d, "path", "") " " get(id, "mcast_rate", "") " " get(id, "macaddr", "") " " \
		get(id, "encryption", "none") " " get(id, "key", "") " " (by == "supplicant" ? get(d, "country", "") : "")
	n = split(names[id], list, " ")
	for (i = 1; i <= n; i++) if (list[i] ~ /^mesh_/) text = text " " list[i] "=" opt[id, list[i]]
	gsub(/[\t\n]/, " ", text)
	return text
}

# the address of an interface whose name already exists (keep: it stays)
function other_mac(base,    first) {
	first = index("0123456789abcdef", tolower(substr(base, 2, 1))) - 1
	# a globally administered address becomes local, as on ath9k (04: -> 06:); a local one 42:.., as on hwsim (02: -> 42:)
	if (int(first / 2) % 2 == 0) return substr(base, 1, 1) substr("0123456789abcdef", first + 3, 1) substr(base, 3)
	first = index("0123456789abcdef", tolower(substr(base, 1, 1))) - 1
	return substr("456789ab0123cdef", first + 1, 1) substr(base, 2)
}

# whether the radio, and whether this interface of it, is recreated
function judge_device(device,    text, n, i, list) {
	text = all_options(id_of(device))
	for (i = 1; i <= sections; i++) if (kind[order[i]] == "wireless.wifi-iface" && get(order[i], "device", "") == device) text = text " |" label[order[i]] all_options(order[i])
	options_of[device] = text
	differs[device] = !(device in was_device) || was_device[device] != text
	whole[device] = !(device in was_device) || was_up[device] != (device in radio_up ? 1 : 0)
	if (series == "19.07" || series == "21.02" || series == "22.03") whole[device] = whole[device] || differs[device]
	else if (antennas(was_device[device]) != antennas(text)) whole[device] = 1
	# a disabled radio is not set up
	pending[device] = differs[device] && ((device in radio_up) || was_up[device])
}
function antennas(text,    found) { return (match(text, / txantenna=[^ ]*/) ? substr(text, RSTART, RLENGTH) : "") (match(text, / rxantenna=[^ ]*/) ? substr(text, RSTART, RLENGTH) : "") }

function judge_face(id, device, ifname, path, algo, mode,    by, base, key) {
	by = algo != "none" || (mode == "mesh" && ibss_rsn) ? "supplicant" : "wdev"
	if (mode == "adhoc" && series == "25.12") by = "wdev"
	key = own_key(id, device, by)
	base = mac_of[path]
	# one that outlived its radio (`stays`) is what wdev.uc finds
	anew = (whole[device] && !((ifname in was_key) && !was_up[device] && was_by[ifname] == "wdev")) || !(ifname in was_key) || was_key[ifname] != key || was_on[ifname] != device
	if (!anew) mac[ifname] = was_mac[ifname]
	else if (get(id, "macaddr", "") ~ /:/) mac[ifname] = tolower(get(id, "macaddr", ""))
	else if (series ~ /^(19.07|21.02|22.03)$/ || whole[device] || !(ifname in was_mac) || (by == "supplicant" && was_by[ifname] == "supplicant")) mac[ifname] = base
	else mac[ifname] = was_mac[ifname] == base ? other_mac(base) : base
	# 25.12: back from wpa_supplicant to the cell that wdev.uc has in its state file, it does nothing, and the supplicant
	# deletes the interface; until the interface changes, or `wifi down` clears the file
	if (is_lost(ifname, device, by, key)) {
		if (phase == 1 && was_by[ifname] == "supplicant") { held[ifname] = 1; pending[device] = 1; return }
		lost[ifname] = 1
		stand(ifname, key, was_mac[ifname], was_index[ifname], device, "lost", key)
		return
	}
	if (anew && phase == 1) { held[ifname] = 1; pending[device] = 1; return }
	if (anew) index_of[ifname] = ++last_index
	else index_of[ifname] = was_index[ifname]
	stand(ifname, key, mac[ifname], index_of[ifname], device, by, by == "wdev" ? key : was_wdev[ifname])
}
function is_lost(ifname, device, by, key) {
	if (series != "25.12" || by != "wdev" || whole[device]) return 0
	return was_by[ifname] == "supplicant" ? was_wdev[ifname] == key : was_by[ifname] == "lost" && was_key[ifname] == key
}
function stand(ifname, key, address, number, device, by, wdev) {
	standing = standing "face\t" ifname "\t" key "\t" address "\t" number "\t" device "\t" by "\t" wdev "\n"
}

# 25.12: wdev.uc is not called where no open interface is left, so a disabled one stays on the air
function stays(ifname, device) {
	return series == "25.12" && !mode_down && device != taken_down && was_by[ifname] == "wdev" && was_on[ifname] == device && !open_faces[device]
}
# the interfaces that wdev.uc sets up
function count_open_faces(    i, id, device) {
	for (i = 1; i <= sections; i++) if (kind[order[i]] == "wireless.wifi-iface") {
		id = order[i]; device = get(id, "device", "")
		if ((device in radio_up) && !yes(get(id, "disabled", "0")) && get(id, "encryption", "none") == "none") open_faces[device]++
	}
}

function frequency(band, channel) {
	channel += 0
	if (band == "2g") return channel >= 1 && channel <= 13 ? 2407 + 5 * channel : 0
	return channel >= 36 && channel <= 177 ? 5000 + 5 * channel : 0
}

function prefix(mask,    part, n, i, bits, value) {
	if (mask ~ /^[0-9]+$/) return mask + 0
	n = split(mask, part, "."); bits = 0
	for (i = 1; i <= n; i++) for (value = part[i] + 0; value > 0; value = (value * 2) % 256) bits++
	return bits
}

# --- radios ----------------------------------------------------------------------------------------------------------

function board_radios(    n, i, field, list) {
	n = split(radios, list, " ")
	for (i = 1; i <= n; i++) {
		split(list[i], field, ",")
		phy_of[field[2]] = i - 1; band_of[field[2]] = field[3]; mac_of[field[2]] = field[4]; max_of[field[2]] = field[5]
	}
}

# the band of the UCI section: `band` from 21.02, `hwmode` before
function band(id) {
	if ((id, "band") in opt) return opt[id, "band"]
	return get(id, "hwmode", "11g") ~ /a/ ? "5g" : "2g"
}

function default_ifname(mode, phy, count) {
	if (series == "19.07" || series == "21.02" || series == "22.03") return "wlan" phy (count ? "-" count : "")
	if (mode == "adhoc") mode = series == "25.12" ? "adhoc" : "ibss"
	return "phy" phy "-" mode count
}

function radio_interfaces(    i, id, device, path, phy, channel, freq, mode, ifname, reason, algo, key, count, width, off) {
	for (i = 1; i <= sections; i++) if (kind[order[i]] == "wireless.wifi-device") {
		id = order[i]
		device = label[id]
		devices[++ndevices] = device
		path = get(id, "path", "")
		radio_path[device] = path
		if (yes(get(id, "disabled", "0")) || device == taken_down) { radio_disabled[device] = 1; continue }
		if (!(path in phy_of)) { radio_failed[device] = 1; continue }
		radio_up[device] = 1
	}
	for (i = 1; i <= ndevices; i++) judge_device(devices[i])
	count_open_faces()
	for (i = 1; i <= sections; i++) if (kind[order[i]] == "wireless.wifi-iface") {
		id = order[i]
		device = get(id, "device", "")
		if (!(device in radio_path)) continue
		off = yes(get(id, "disabled", "0"))
		if (off && !stays(get(id, "ifname", ""), device)) continue
		mode = get(id, "mode", "ap")
		path = radio_path[device]; phy = phy_of[path]
		count = made[device, mode]++
		ifname = get(id, "ifname", default_ifname(mode, phy, count))
		if (!off) faces[device] = faces[device] " " id
		off = off || !(device in radio_up)
		if (mode_down || (off && !stays(ifname, device))) continue
		if (!off) iface_name[id] = ifname
		algo = get(id, "encryption", "none"); key = get(id, "key", "")
		sub(/\+.*/, "", algo)
		if (algo == "") algo = "none"
		if (off) {
			mac[ifname] = was_mac[ifname]; index_of[ifname] = was_index[ifname]
			stand(ifname, was_key[ifname], mac[ifname], index_of[ifname], device, "wdev", was_wdev[ifname])
		} else judge_face(id, device, ifname, path, algo, mode)
		if (ifname in held) { delete iface_name[id]; continue }
		if (ifname in lost) continue
		exists[ifname] = 1; is_radio[ifname] = 1
		split(get(id, "network", ""), wanted, " ")
		network_of[ifname] = wanted[1]
		if (mode == "ap" && wanted[1] != "") attach(wanted[1], ifname)
		freq = band(id_of(device)) == band_of[path] ? frequency(band_of[path], get(id_of(device), "channel", "auto")) : 0
		if (algo == "none") key = ""
		# an IBSS cannot choose its channel, and encrypts only with a full supplicant; 25.12 then joins open, silently
		if (mode == "adhoc" && algo != "none" && series == "25.12") { algo = "none"; key = "" }
		joined = freq && (algo == "none" || ibss_rsn)
		if (joined && algo != "none") {
			encrypted[ifname] = 1
			# hostapd.sh deletes the socket at each set-up, and wpa_supplicant.uc adds only an interface that differs
			socket[ifname] = anew || series !~ /^(23.05|24.10)$/ ? "made" : differs[device] ? "deleted" : "kept"
		}
		width = get(id_of(device), "htmode", "NOHT")
		iw_line = iw_line ifname "\t" mode "\t" mac[ifname] "\t" phy "\t" freq "\t" get(id_of(device), "channel", "0") "\t" width "\t" \
			(mode == "mesh" ? get(id, "mesh_id", "") : get(id, "ssid", "OpenWrt")) "\t" get(id, "bssid", "00:00:00:00:00:00") "\t" \
			power(device, path) "\t" (joined ? 1 : 0) "\t" algo "\t" get(id_of(device), "country", "00") "\t" index_of[ifname] "\n"
		if (joined && (mode == "adhoc" || mode == "mesh")) {
			cell[ifname] = device "\t" ifname "\t" mode "\t" freq "\t" \
				(mode == "mesh" ? get(id, "mesh_id", "") "\t-" : get(id, "ssid", "") "\t" get(id, "bssid", "")) "\t" algo "\t" key "\t" mac[ifname]
			cells[++ncells] = ifname
		}
	}
	leftovers()
}

# 25.12: neither does wdev.uc remove an interface whose section is gone, from a radio without another open one. It stays in
# its cell, but no longer in bat0.
function leftovers(    ifname, device) {
	for (ifname in was_key) {
		device = was_on[ifname]
		if ((ifname in exists) || (ifname in held) || (ifname in lost) || !(device in radio_path) || !stays(ifname, device)) continue
		exists[ifname] = 1; is_radio[ifname] = 1
		mac[ifname] = was_mac[ifname]; index_of[ifname] = was_index[ifname]
		stand(ifname, was_key[ifname], mac[ifname], index_of[ifname], device, "wdev", was_wdev[ifname])
		iw_line = iw_line was_iw[ifname]
		if (ifname in was_cell) { cell[ifname] = was_cell[ifname]; cells[++ncells] = ifname }
	}
}

function id_of(device) { return "wireless." device }
function power(device, path,    asked) { asked = get(id_of(device), "txpower", max_of[path]) + 0; return asked > max_of[path] ? max_of[path] : asked }
function attach(network, ifname) { attached[network] = attached[network] " " ifname }

# --- devices and interfaces ------------------------------------------------------------------------------------------

# the bridges, their ports, and the devices that exist
function all_devices(    i, n, id, list, name) {
	n = split(ports, list, " ")
	for (i = 1; i <= n; i++) { exists[list[i]] = 1; mac[list[i]] = lan_mac; wired[list[i]] = 1; names_of_ports[list[i]] = 1 }
	exists["lo"] = 1; mac["lo"] = "00:00:00:00:00:00"
	# bat0 exists once a hard interface's master is configured and the module is loaded
	for (i = 1; i <= sections; i++) {
		id = order[i]
		if (kind[id] != "network.interface") continue
		if (get(id, "proto", "none") == "batadv" && batman) {
			exists[label[id]] = 1; mac[label[id]] = soft_mac(label[id]); is_soft[label[id]] = 1
			algorithm[label[id]] = get(id, "routing_algo", "BATMAN_IV")
		}
	}
	for (i = 1; i <= sections; i++) {
		id = order[i]
		if (kind[id] == "network.device" && get(id, "type", "") == "bridge") make_bridge(get(id, "name", ""), get(id, "ports", get(id, "ifname", "")) attached_to(get(id, "name", "")))
		if (kind[id] == "network.interface" && get(id, "type", "") == "bridge") {
			name = "br-" label[id]
			make_bridge(name, get(id, "ifname", "") attached[label[id]])
			device_of[id] = name
		}
	}
}

# the radio interfaces of the networks on a bridge (21.02 on), such as an access point's
function attached_to(bridge,    i, id, members) {
	members = ""
	for (i = 1; i <= sections; i++) {
		id = order[i]
		if (kind[id] == "network.interface" && get(id, "device", "") == bridge) members = members attached[label[id]]
	}
	return members
}

# as set in the configuration, else a new address, as the kernel chooses a random one at each creation
function soft_mac(name,    set) { set = set_mac(name); return set == "" ? "fe" substr(lan_mac, 3) : set }
# the MAC of a device by its own section (21.02 on) or by an interface's (19.07)
function set_mac(name,    i, id) {
	for (i = 1; i <= sections; i++) {
		id = order[i]
		if (get(id, "macaddr", "") == "") continue
		if (kind[id] == "network.device" && get(id, "name", "") == name) return get(id, "macaddr", "")
		if (kind[id] == "network.interface" && get(id, "ifname", "") == name) return get(id, "macaddr", "")
	}
	return ""
}

function make_bridge(name, members,    n, i, list) {
	exists[name] = 1; mac[name] = lan_mac; is_bridge[name] = 1
	n = split(members, list, " ")
	for (i = 1; i <= n; i++) if (list[i] in exists) { bridge_ports[name] = bridge_ports[name] " " list[i]; bridge_of[list[i]] = name }
}

function reaches(device, flag,    n, i, list) {
	if (flag == "soft" ? device in is_soft : device in wired) return 1
	n = split(bridge_ports[device], list, " ")
	for (i = 1; i <= n; i++) if (flag == "soft" ? list[i] in is_soft : list[i] in wired) return 1
	return 0
}

function interfaces(    i, id, proto, device, n, list, j, ifname, separator, address, mask, line, errors, up) {
	dump = "{\n\t\"interface\": ["
	separator = "\n"
	for (i = 1; i <= sections; i++) {
		id = order[i]
		if (kind[id] != "network.interface") continue
		proto = get(id, "proto", "none")
		device = id in device_of ? device_of[id] : get(id, "device", get(id, "ifname", ""))
		sub(/ .*/, "", device)
		address = ""; errors = ""; up = 0
		if (proto == "batadv") { device = label[id]; up = batman ? 1 : 0; if (!up) errors = "INVALID_PROTO" }
		else if (proto == "batadv_hardif") {
			ifname = ""
			for (j = 1; j <= ncells; j++) if (network_of[cells[j]] == label[id]) ifname = cells[j]
			if (ifname == "" && device in exists) ifname = device
			if (!batman) errors = "INVALID_PROTO"
			else if (ifname != "" && get(id, "master", "") in is_soft) {
				up = 1; device = ifname
				master[ifname] = get(id, "master", "")
				mtu[ifname] = get(id, "mtu", 1500)
			}
		} else if (proto == "static") {
			up = device in exists
			address = get(id, "ipaddr", ""); mask = get(id, "netmask", "255.255.255.255")
			sub(/ .*/, "", address)
			if (address ~ /\//) { mask = address; sub(/.*\//, "", mask); sub(/\/.*/, "", address) }
		} else up = device in exists
		if (yes(get(id, "disabled", "0")) || !(get(id, "auto", "1") ~ /1/) || mode == "down") up = 0
		if (up && address != "") {
			printf "%s %s/%s\n", device, address, prefix(mask) > (run "/addresses.new")
			if (label[id] != "loopback")
				effective = effective "addr\t" label[id] "\t" device "\t" address "\t" prefix(mask) "\t" reaches(device, "soft") "\t" reaches(device, "wired") "\n"
		}
		dump = dump separator "\t\t{\n\t\t\t\"interface\": " json(label[id]) ",\n\t\t\t\"up\": " (up ? "true" : "false") \
			",\n\t\t\t\"pending\": false,\n\t\t\t\"available\": " (up || errors == "" ? "true" : "false") \
			",\n\t\t\t\"autostart\": true,\n\t\t\t\"dynamic\": false"
		if (up) dump = dump ",\n\t\t\t\"uptime\": @" now "@,\n\t\t\t\"l3_device\": " json(device)
		dump = dump ",\n\t\t\t\"proto\": " json(proto)
		if (device != "") dump = dump ",\n\t\t\t\"device\": " json(device)
		if (up) dump = dump ",\n\t\t\t\"metric\": 0,\n\t\t\t\"ipv4-address\": [" (address == "" ? "" : \
			"\n\t\t\t\t{\n\t\t\t\t\t\"address\": " json(address) ",\n\t\t\t\t\t\"mask\": " prefix(mask) "\n\t\t\t\t}\n\t\t\t") "]"
		if (errors != "") dump = dump ",\n\t\t\t\"errors\": [\n\t\t\t\t{\n\t\t\t\t\t\"subsystem\": \"proto\",\n\t\t\t\t\t\"code\": " json(errors) "\n\t\t\t\t}\n\t\t\t]"
		dump = dump "\n\t\t}"
		if (up) up_device[label[id]] = device
		separator = ",\n"
	}
	print dump "\n\t]\n}" > (run "/dump")
}

# static routes of interfaces that are up: "route DEVICE TARGET PREFIX GATEWAY", and those with a gateway for the kernel
function routes(    i, id, device, target, mask, kernel) {
	for (i = 1; i <= sections; i++) {
		id = order[i]
		if (kind[id] != "network.route" || !(get(id, "interface", "") in up_device)) continue
		device = up_device[get(id, "interface", "")]
		target = get(id, "target", "0.0.0.0"); mask = get(id, "netmask", "255.255.255.255")
		if (target ~ /\//) { mask = target; sub(/.*\//, "", mask); sub(/\/.*/, "", target) }
		effective = effective "route\t" device "\t" target "\t" prefix(mask) "\t" get(id, "gateway", "") "\n"
		if (get(id, "gateway", "") != "") kernel = kernel device " " target "/" prefix(mask) " " get(id, "gateway", "") "\n"
	}
	printf "%s", kernel > (run "/routes.new")
}

function wireless_status(    i, d, text, n, list, j, id, m, k, o, first) {
	text = "{"
	for (i = 1; i <= ndevices; i++) {
		d = devices[i]
		text = text (i > 1 ? "," : "") "\n\t" json(d) ": {\n\t\t\"up\": " ((d in radio_up) && !mode_down && !(phase == 1 && pending[d]) ? "true" : "false") \
			",\n\t\t\"pending\": " (phase == 1 && pending[d] && !mode_down ? "true" : "false") ",\n\t\t\"autostart\": " (d in radio_failed ? "false" : "true") \
			",\n\t\t\"disabled\": " (d in radio_disabled ? "true" : "false") \
			",\n\t\t\"retry_setup_failed\": " (d in radio_failed ? "true" : "false") ",\n\t\t\"config\": {"
		text = text options(id_of(d), "\t\t\t", " ") "\n\t\t},\n\t\t\"interfaces\": ["
		n = split(faces[d], list, " ")
		first = 1
		for (j = 1; j <= n; j++) {
			id = list[j]
			text = text (first ? "" : ",") "\n\t\t\t{\n\t\t\t\t\"section\": " json(label[id])
			first = 0
			if (id in iface_name) text = text ",\n\t\t\t\t\"ifname\": " json(iface_name[id])
			text = text ",\n\t\t\t\t\"config\": {" options(id, "\t\t\t\t\t", " device ") "\n\t\t\t\t}\n\t\t\t}"
		}
		text = text "\n\t\t]\n\t}"
	}
	print text "\n}" > (run "/wireless")
}

# options of a section as JSON members; netifd types the options it knows
function options(id, indent, without,    n, list, k, name, value, text, parts, m, j) {
	n = split(names[id], list, " ")
	text = ""
	for (k = 1; k <= n; k++) {
		name = list[k]
		if (index(without, " " name " ") || name == "type") continue
		value = opt[id, name]
		if (name == "network") {
			m = split(value, parts, " "); value = "["
			for (j = 1; j <= m; j++) value = value (j > 1 ? "," : "") "\n" indent "\t" json(parts[j])
			value = value "\n" indent "]"
		}
		else if (name ~ /^(disabled|hidden|isolate|noscan|mesh_fwding)$/) value = yes(value) ? "true" : "false"
		else if (name ~ /^(txpower|distance|beacon_int|mcast_rate|rts|frag|txantenna|rxantenna)$/ && value ~ /^[0-9]+$/) value = value + 0
		else value = json(value)
		text = text (text == "" ? "" : ",") "\n" indent json(name) ": " value
	}
	return text
}

# --- /sys ------------------------------------------------------------------------------------------------------------

# interface indexes of the permanent devices: lo, ports, bridges, bat0
function device_index(name,    n, i, list) {
	if (name == "lo") return 1
	n = split(ports, list, " ")
	for (i = 1; i <= n; i++) if (list[i] == name) return 1 + i
	return name in is_soft ? 9 + length(name) % 4 : 13 + length(name) % 7
}

function sys_script(    d, file, port, n, i, list, dir) {
	file = run "/sys"
	print "cd /sys/class/net || exit 1" > file
	# remove what the last run created and this one does not
	print "for d in *; do case \" lo " ports " \" in *\" $d \"*) ;; *) [ -e '/tmp/run/netifd/has.'\"$d\" ] || rm -rf \"$d\" ;; esac; done" > (run "/sys.end")
	close(run "/sys.end")
	printf "rm -f /tmp/run/netifd/has.*; [ -d /var/run/wpa_supplicant ] || mkdir -p /var/run/wpa_supplicant\n" > file
	kept = ""
	for (d in encrypted) if (socket[d] == "kept") kept = kept " " d
	print "for d in /var/run/wpa_supplicant/*; do case \"" kept " \" in *\" ${d##*/} \"*) ;; *) rm -f \"$d\" ;; esac; done" > file
	for (d in encrypted) if (socket[d] == "made") printf ": >/var/run/wpa_supplicant/%s\n", d > file
	# as hostapd.sh names it; 25.12: supplicant.uc. It stays when the interface goes
	for (d in encrypted) printf ": >/var/run/wpa%ssupplicant-%s.conf\n", (series == "25.12" ? "-" : "_"), d > file
	printf "" > (run "/supplicants")
	for (d in encrypted) print d > (run "/supplicants")
	for (d in exists) {
		printf ": >/tmp/run/netifd/has.%s\n", d > file
		printf "[ -d %s ] || mkdir %s\necho %s >%s/address\necho %s >%s/operstate\necho %s >%s/mtu\necho 1 >%s/carrier\n", \
			d, d, mac[d], d, (d == "lo" ? "unknown" : "up"), d, (d in mtu ? mtu[d] : (d == "lo" ? 65536 : 1500)), d, d > file
		if (d in is_bridge) {
			printf "[ ! -d %s/brif ] || rm -rf %s/brif; mkdir -p %s/bridge %s/brif", d, d, d, d > file
			n = split(bridge_ports[d], list, " ")
			for (i = 1; i <= n; i++) printf " %s/brif/%s", d, list[i] > file
			printf "\necho 0 >%s/bridge/stp_state\n", d > file
		}
		printf "echo %d >%s/ifindex\n", (d in index_of ? index_of[d] : device_index(d)), d > file
		if (d in is_radio) printf "[ -d %s/phy80211 ] || mkdir -p %s/wireless %s/phy80211\n", d, d, d > file
		if (d in is_soft) printf "[ -d %s/mesh ] || mkdir -p /sys/module/batman_adv %s/mesh\n", d, d > file
		if (d in bridge_of) printf "ln -sfn ../%s %s/master\n", bridge_of[d], d > file
		else if (d in master) printf "ln -sfn ../%s %s/master\n", master[d], d > file
		else printf "[ ! -L %s/master ] || rm -f %s/master\n", d, d > file
	}
	print ". /tmp/run/netifd/sys.end" > file
}

END {
	mode_down = mode != "up"
	printf "" > (run "/addresses.new")
	board_radios()
	read_standing()
	radio_interfaces()
	all_devices()
	interfaces()
	routes()
	wireless_status()
	printf "%s", iw_line > (run "/iw")
	for (i = 1; i <= ncells; i++) {
		effective = effective "cell\t" cell[cells[i]] "\t" (cells[i] in master ? master[cells[i]] "\t" algorithm[master[cells[i]]] : "-\t-") "\t" index_of[cells[i]] "\n"
	}
	printf "%s", effective > (run "/effective")
	if (phase == 2) {
		if (mode_down) standing = ""
		else for (i = 1; i <= ndevices; i++) standing = standing "device\t" devices[i] "\t" options_of[devices[i]] "\t" (devices[i] in radio_up ? 1 : 0) "\n"
		printf "%s", standing > (run "/radios.new")
		print last_index > (run "/last_index")
	} else {
		waits = ""
		for (i = 1; i <= ndevices; i++) if (pending[devices[i]]) waits = waits " " devices[i]
		print waits > (run "/waits")
	}
	sys_script()
}
