# Stand-in for iw, output. A deleted station that is still heard reappears with its next beacon, immediately; a silent one
# stays in the table for a minute, and does not reappear when deleted. `now` is Unix time, as in air/heard.
BEGIN {
	FS = "\t"
	mac = tolower(mac); now = systime()
	while ((getline line < "/tmp/run/netifd/forgotten") > 0) { split(line, told, " "); since[told[1] " " told[2]] = told[3] }
	# a file that is open for reading is not written
	close("/tmp/run/netifd/forgotten")
}
function describe(indent, face,    width, type) {
	type = face[2] == "adhoc" ? "IBSS" : face[2] == "mesh" ? "mesh point" : face[2] == "sta" ? "managed" : "AP"
	printf "%sifindex %d\n%swdev 0x%x\n%saddr %s\n", indent, face[14], indent, face[4] * 4294967296 + 2, indent, face[3]
	if (face[11]) printf "%s%s %s\n", indent, (type == "mesh point" ? "ssid" : "ssid"), face[8]
	printf "%stype %s\n", indent, type
	if (indent == "\t") printf "%swiphy %d\n", indent, face[4]
	if (face[11]) {
		width = face[7] ~ /40/ ? "40 MHz" : face[7] ~ /80/ ? "80 MHz" : face[7] ~ /20/ ? "20 MHz" : "20 MHz (no HT)"
		printf "%schannel %d (%d MHz), width: %s, center1: %d MHz\n", indent, face[6], face[5], width, face[5]
	}
	printf "%stxpower %.2f dBm\n", indent, face[10]
}
FILENAME ~ /iw$/ {
	n = split($0, face, "\t")
	if (device == "") {
		if (face[4] != last || !seen++) printf "phy#%d\n", face[4]
		last = face[4]
		printf "\tInterface %s\n", face[1]
		describe("\t\t", face)
		next
	}
	if (face[1] != device) next
	found = 1
	type = face[2]
	joined = face[11]
	frequency = face[5]
	if (verb == "info") { printf "Interface %s\n", device; describe("\t", face) }
	if (verb == "link") {
		if (face[11] && face[2] == "adhoc") printf "Joined IBSS %s (on %s)\n\tSSID: %s\n\tfreq: %d\n", face[9], device, face[8], face[5]
		else print "Not connected."
	}
}
# thermal noise of 20 MHz and a noise figure of 6 dB: what ath9k reports in a quiet place
function noise() { return -95 }
# the highest rate of two streams in 20 MHz for this signal: about the SNR that MCS 0 to 7 need, and 3 dB for the second stream
function mcs_of(signal,    snr, i, need) {
	snr = signal - noise()
	split("5 8 11 14 18 22 25 27", need, " ")
	for (i = 8; i > 1 && snr < need[i] + 3; i--);
	return snr < need[1] + 3 ? 0 : 8 + i - 1
}
function rate_of(mcs,    rates) {
	split("7.2 14.4 21.7 28.9 43.3 57.8 65 72.2 14.4 28.9 43.3 57.8 86.7 115.6 130 144.4", rates, " ")
	return rates[mcs + 1]
}
# beacons and OGMs of every station that is heard, and its own: half a per cent of the time each
FILENAME ~ /heard$/ && $1 == "S" && $2 == device && verb == "survey" { if (!$8) beacons++ }
# deleted and not heard since
FILENAME ~ /heard$/ && $1 == "S" && $8 && since[$2 " " $3] >= $8 { next }
FILENAME ~ /heard$/ && $1 == "S" && $2 == device && verb == "station" && act == "del" { if ($3 == mac) known = 1; next }
FILENAME ~ /heard$/ && $1 == "S" && $2 == device && verb == "station" && (act == "dump" || $3 == mac) {
	known = 1
	signal = $4
	mcs = mcs_of(signal)
	age = ($7 ? now - $7 : uptime)
	sent = int(10 * age)
	# the share of frames that are lost on their way there, from the TQ
	lost = 1 - $6 / 144.4
	made = $7 > since[device " " $3] ? $7 : since[device " " $3]
	printf "Station %s (on %s)\n\tinactive time:\t%d ms\n\trx bytes:\t%d\n\trx packets:\t%d\n\ttx bytes:\t%d\n\ttx packets:\t%d\n\ttx retries:\t%d\n\ttx failed:\t%d\n\trx drop misc:\t0\n", $3, device, $5 + ($8 ? (now - $8) * 1000 : 0), \
		sent * 80, sent, sent * 80, sent, sent * lost / (1.01 - lost), sent * lost * lost * lost * lost * lost * lost * lost
	printf "\tsignal:  \t%d [%d, %d] dBm\n\tsignal avg:\t%d [%d, %d] dBm\n", $4, $4 - 2, $4 - 4, $4, $4 - 2, $4 - 4
	printf "\ttx bitrate:\t%.1f MBit/s MCS %d short GI\n\trx bitrate:\t%.1f MBit/s MCS %d short GI\n\texpected throughput:\t%.2fMbps\n\tauthorized:\tyes\n\tauthenticated:\tyes\n\tassociated:\tyes\n\tconnected time:\t%d seconds\n", rate_of(mcs), mcs, rate_of(mcs), mcs, $6 * 0.4, made ? now - made : uptime
}
function fail(text, number) { printf "command failed: %s (-%d)\n", text, number > "/dev/stderr"; exit 256 - number }
END {
	if (verb == "survey" && found && joined) {
		share = 0.005 * (beacons + 1)
		if (share > 0.7) share = 0.7
		printf "Survey data from %s\n\tfrequency:\t\t\t%d MHz [in use]\n\tnoise:\t\t\t\t%d dBm\n", device, frequency, noise()
		printf "\tchannel active time:\t\t%d ms\n\tchannel busy time:\t\t%d ms\n", uptime * 1000, uptime * 1000 * share
		printf "\tchannel receive time:\t\t%d ms\n\tchannel transmit time:\t\t%d ms\n", uptime * 1000 * (share - 0.005), uptime * 5
	}
	if (device != "" && !found) fail("No such device", 19)
	# ad-hoc cells: Linux 5.7 and later; 19.07 has the wireless stack of 4.19
	if (verb == "station" && act == "del" && type == "adhoc" && series == "19.07") fail("Operation not supported", 95)
	if (verb == "station" && act != "dump" && !known) fail("No such file or directory", 2)
	if (verb == "station" && act == "del") print device, mac, now >>"/tmp/run/netifd/forgotten"
}
