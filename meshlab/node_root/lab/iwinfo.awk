# Stand-in for rpcd's iwinfo object: `info` and `assoclist` of one device, from the files of netifd and the fleet.
BEGIN { FS = "\t"; now = systime() }
FILENAME ~ /iw$/ && $1 == device { found = 1; n = split($0, face, "\t") }
FILENAME ~ /heard$/ && $1 == "S" && $2 == device { mac[++stations] = $3; signal[stations] = $4; age[stations] = $5 + ($8 ? (now - $8) * 1000 : 0); connected[stations] = $7 ? now - $7 : 60; rate[stations] = $6 }
END {
	if (!found) exit 1
	if (want == "info") {
		best = 0
		for (i = 1; i <= stations; i++) if (best == 0 || signal[i] > best) best = signal[i]
		print "{"
		printf "\t\"phy\": \"phy%s\",\n", face[4]
		if (face[11]) printf "\t\"ssid\": \"%s\",\n\t\"bssid\": \"%s\",\n", face[8], toupper(face[9])
		printf "\t\"country\": \"%s\",\n\t\"mode\": \"%s\",\n", face[13], (face[2] == "adhoc" ? "Ad-Hoc" : face[2] == "mesh" ? "Mesh Point" : "Master")
		if (face[5]) printf "\t\"channel\": %d,\n\t\"frequency\": %d,\n", face[6], face[5]
		printf "\t\"frequency_offset\": 0,\n\t\"txpower\": %d,\n\t\"txpower_offset\": 0,\n", face[10]
		if (stations) printf "\t\"quality\": %d,\n\t\"quality_max\": 70,\n\t\"signal\": %d,\n", best + 110 > 70 ? 70 : best + 110, best
		printf "\t\"noise\": -95,\n"
		if (stations) printf "\t\"bitrate\": %d,\n", rate[1] * 1000
		printf "\t\"encryption\": {\n\t\t\"enabled\": %s\n\t},\n", face[12] == "none" ? "false" : "true"
		printf "\t\"htmodes\": [\n\t\t\"HT20\",\n\t\t\"HT40\"\n\t],\n\t\"hwmodes\": [\n\t\t\"n\"\n\t],\n"
		printf "\t\"hardware\": {\n\t\t\"name\": \"Generic MAC80211\"\n\t}\n}\n"
		exit 0
	}
	printf "{\n\t\"results\": ["
	for (i = 1; i <= stations; i++) {
		printf "%s\n\t\t{\n\t\t\t\"mac\": \"%s\",\n\t\t\t\"signal\": %d,\n\t\t\t\"signal_avg\": %d,\n\t\t\t\"noise\": -95,\n\t\t\t\"inactive\": %d,\n", \
			(i > 1 ? "," : ""), toupper(mac[i]), signal[i], signal[i], age[i]
		printf "\t\t\t\"connected_time\": %d,\n\t\t\t\"thr\": %d,\n\t\t\t\"rx\": {\n\t\t\t\t\"drop_misc\": 0,\n\t\t\t\t\"packets\": 1200,\n\t\t\t\t\"bytes\": 96000,\n\t\t\t\t\"ht\": true,\n\t\t\t\t\"vht\": false,\n\t\t\t\t\"mhz\": 20,\n\t\t\t\t\"rate\": %d,\n\t\t\t\t\"mcs\": 15,\n\t\t\t\t\"40mhz\": false,\n\t\t\t\t\"short_gi\": true\n\t\t\t},\n", \
			connected[i], rate[i] * 400, rate[i] * 1000
		printf "\t\t\t\"tx\": {\n\t\t\t\t\"failed\": 0,\n\t\t\t\t\"retries\": 12,\n\t\t\t\t\"packets\": 1100,\n\t\t\t\t\"bytes\": 88000,\n\t\t\t\t\"ht\": true,\n\t\t\t\t\"vht\": false,\n\t\t\t\t\"mhz\": 20,\n\t\t\t\t\"rate\": %d,\n\t\t\t\t\"mcs\": 15,\n\t\t\t\t\"40mhz\": false,\n\t\t\t\t\"short_gi\": true\n\t\t\t}\n\t\t}", rate[i] * 1000
	}
	print "\n\t]\n}"
}
