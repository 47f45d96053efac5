# The loaded rules (lab/firewall_rules.awk) and netifd's lines -> the same lines, each `addr` with 1 or 0 appended: whether
# a new connection to port 22 is accepted, and "forward FROM TO" for the devices between which connections are forwarded.
# The first matching rule decides; without a firewall everything is accepted and forwarded ("forward * *").
BEGIN { FS = OFS = "\t" }
FILENAME ~ /loaded$/ && $1 == "forward" { print "forward", $2, $3; next }
FILENAME ~ /loaded$/ { device[++n] = $2; address[n] = $3; verdict[n] = $4; next }
$1 == "addr" {
	admitted = 1
	for (i = 1; i <= n; i++) if ((device[i] == "*" || device[i] == $3) && (address[i] == "*" || address[i] == $4)) {
		admitted = verdict[i] == "ACCEPT"
		break
	}
	print $0, admitted
	next
}
{ print }
END { if (!n) print "forward", "*", "*" }
