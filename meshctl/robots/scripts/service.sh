# service VERB: start, stop or restart, as systemd does it.
[ -e "$unit_file" ] || die not-installed "udp-mesh is not installed here"
alone
systemctl "$1" "$unit" || die service "systemctl $1 $unit failed; see the log"
echo "$(systemctl is-active "$unit" 2>/dev/null)"
