# service VERB: stop or restart, as systemd does it, the daemon and the ROS bridge if there is one. Prints their states.
[ -n "$(ours)" ] || die not-installed "udp-mesh is not installed here"
alone
[ "$1" = stop ] || none_masked
for service in $(ours); do
	systemctl "$1" "$service" || die service "systemctl $1 $service failed: $(systemctl is-active "$service" 2>/dev/null)"
done
for service in $(ours); do echo "$service $(systemctl is-active "$service" 2>/dev/null)"; done
