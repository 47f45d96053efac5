# remove PURGE: stops and removes the daemon. With `purge` also its stored messages and its user; otherwise the messages
# stay in /var/lib/udp-mesh for the next install.
purge=$1
alone
for service in $(ours); do
	systemctl disable --now "$service" >/dev/null 2>&1
	rm -f "$units/$service"
done
systemctl daemon-reload
rm -rf "$root"
if [ "$purge" = purge ]; then
	rm -rf /var/lib/udp-mesh
	! id "$account" >/dev/null 2>&1 || userdel "$account" 2>/dev/null || die account "cannot remove the user $account"
fi
echo removed
