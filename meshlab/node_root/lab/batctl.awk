# Stand-in for batctl, output. effective: cell lines of this node's radios; heard: N neighbor, O originator.
BEGIN { FS = "\t" }
FILENAME ~ /effective$/ && $1 == "cell" && $11 == soft { faces[++nfaces] = $3; index_of[$3] = $13; address[$3] = $10; algorithm = $12 }
FILENAME ~ /heard$/ && $1 == "N" && $2 in index_of { neighbour[++n] = $3; n_face[n] = $2; n_age[n] = $4; n_tq[n] = $5 }
FILENAME ~ /heard$/ && $1 == "O" && $2 in index_of { origin[++o] = $3; o_face[o] = $2; o_hop[o] = $4; o_tq[o] = $5; o_age[o] = $6; best[o] = $7 }
# BATMAN_V measures throughput: derived from the TQ, at most 100 Mbit/s
function metric(tq) { return algorithm == "BATMAN_V" ? "\"throughput\":" int(tq * 100000 / 255) : "\"tq\":" tq }
function face(name) { return "\"hard_ifindex\":" index_of[name] (series == "21.02" ? "" : ",\"hard_ifname\":\"" name "\"") }
function header() {
	printf "[B.A.T.M.A.N. adv %s, MainIF/MAC: %s/%s (%s/%s %s)]\n", version, faces[1], address[faces[1]], soft, own, algorithm
}
END {
	if (algorithm == "") algorithm = "BATMAN_IV"
	if (verb == "originators_json") {
		printf "["
		for (i = 1; i <= o; i++) printf "%s{%s,\"orig_address\":\"%s\",%s\"last_seen_msecs\":%d,\"neigh_address\":\"%s\",%s}", \
			(i > 1 ? "," : ""), face(o_face[i]), origin[i], (best[i] ? "\"best\":true," : ""), o_age[i], o_hop[i], metric(o_tq[i])
		print "]"
	} else if (verb == "neighbors_json") {
		printf "["
		for (i = 1; i <= n; i++) printf "%s{%s,\"last_seen_msecs\":%d,\"neigh_address\":\"%s\"%s}", \
			(i > 1 ? "," : ""), face(n_face[i]), n_age[i], neighbour[i], (algorithm == "BATMAN_V" ? "," metric(n_tq[i]) : "")
		print "]"
	} else if (verb == "hardifs_json") {
		printf "["
		for (i = 1; i <= nfaces; i++) printf "%s{%s,\"active\":true}", (i > 1 ? "," : ""), face(faces[i])
		print "]"
	} else if (verb == "mesh_json") {
		printf "{\"version\":\"%s\",\"algo_name\":\"%s\",\"mesh_ifindex\":6,\"mesh_ifname\":\"%s\",\"mesh_address\":\"%s\"", version, algorithm, soft, own
		if (nfaces) printf ",%s", face(faces[1])
		printf ",\"aggregated_ogms_enabled\":true,\"ap_isolation_enabled\":false,\"bonding_enabled\":false"
		option("bridge_loop_avoidance", "bridge_loop_avoidance_enabled", 1); option("distributed_arp_table", "distributed_arp_table_enabled", 1)
		option("fragmentation", "fragmentation_enabled", 1); option("gw_mode", "gw_mode", "off"); option("hop_penalty", "hop_penalty", 30)
		option("multicast_mode", "multicast_forceflood_enabled", 0); option("orig_interval", "orig_interval", 1000)
		print "}"
	} else if (verb == "transtable_global_json" || verb == "gateways_json" || verb == "bla_claim_json" || verb == "bla_backbone_json" || verb == "transtable_local_json" || verb == "dat_cache_json") print "[]"
	else if (verb == "o" || verb == "originators") {
		header()
		print "   Originator        last-seen (#/255) Nexthop           [outgoingIF]"
		for (i = 1; i <= o; i++) printf " %s %s %4d.%03ds   (%3d) %s [%10s]\n", (best[i] ? "*" : " "), origin[i], o_age[i] / 1000, o_age[i] % 1000, o_tq[i], o_hop[i], o_face[i]
	} else if (verb == "n" || verb == "neighbors") {
		header()
		print "IF             Neighbor              last-seen"
		for (i = 1; i <= n; i++) printf " %10s\t  %s %4d.%03ds\n", n_face[i], neighbour[i], n_age[i] / 1000, n_age[i] % 1000
	} else if (verb == "tg" || verb == "transglobal") {
		if (arguments !~ / -H/) { header(); print "   Client             VID Flags Last ttvn     Via        ttvn  (CRC       )" }
		# of each originator its own bat0, a unicast address
		if (arguments !~ / -m/) for (i = 1; i <= o; i++) if (best[i]) \
			printf " * fe%s   -1 [....] (  1) %s (  1) (0x00000000)\n", substr(origin[i], 3), origin[i]
	} else if (verb == "statistics" || verb == "s") {
		# one OGM a second of its own, and one of every originator
		ogms = int(uptime)
		printf "\ttx: %d\n\ttx_bytes: %d\n\ttx_dropped: 0\n\trx: %d\n\trx_bytes: %d\n", ogms * 2, ogms * 400, ogms * 2, ogms * 400
		printf "\tforward: 0\n\tforward_bytes: 0\n\tmgmt_tx: %d\n\tmgmt_tx_bytes: %d\n", ogms * (o + 1), ogms * (o + 1) * 72
		printf "\tmgmt_rx: %d\n\tmgmt_rx_bytes: %d\n", ogms * n * (o + 1), ogms * n * (o + 1) * 72
	} else if (verb == "if" || verb == "interface") for (i = 1; i <= nfaces; i++) print faces[i] ": active"
	else if (verb == "ra" || verb == "routing_algo") print algorithm
	else if (verb == "it" || verb == "orig_interval") print configured("orig_interval", 1000)
	else if (verb == "bl" || verb == "bridge_loop_avoidance") print configured("bridge_loop_avoidance", 1) ? "enabled" : "disabled"
	else if (verb == "hp" || verb == "hop_penalty") print configured("hop_penalty", 30)
	else { print "Error - no command specified" > "/dev/stderr"; exit 1 }
}
function configured(name, otherwise,    command, value) {
	command = "uci -q get network." soft "." name
	if ((command | getline value) <= 0) value = otherwise
	close(command)
	return value
}
function options(    command, line, at, name) {
	if (read++) return
	command = "uci -q show network." soft
	while ((command | getline line) > 0) {
		at = index(line, "="); name = substr(line, 1, at - 1); sub(/.*\./, "", name)
		value_of[name] = substr(line, at + 1); gsub(/'/, "", value_of[name])
	}
	close(command)
}
function option(name, shown, otherwise,    value) {
	options()
	value = name in value_of ? value_of[name] : otherwise
	if (name == "multicast_mode") value = name in value_of ? !value : 0
	if (shown ~ /enabled$/) printf ",\"%s\":%s", shown, value + 0 ? "true" : "false"
	else printf value ~ /^[0-9]+$/ ? ",\"%s\":%s" : ",\"%s\":\"%s\"", shown, value
}
