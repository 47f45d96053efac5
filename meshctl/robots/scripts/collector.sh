# collector: gives the collector a key of its own if it has none, and replaces what it knows of the radios by the tar on
# standard input (known_hosts, names.json). Prints its public key. The private part never leaves this computer.
alone
state=/var/lib/udp-mesh
place=$state/collector
mkdir -p -m 700 "$state" && mkdir -p -m 700 "$place" || die no-space "cannot make $place"
if [ ! -s "$place/id_ed25519" ] || [ ! -s "$place/id_ed25519.pub" ]; then
	rm -f "$place"/id_ed25519*
	ssh-keygen -q -t ed25519 -N '' -C "collector of $1" -f "$place/id_ed25519" </dev/null ||
		die no-space "cannot make a key in $place"
fi
rm -rf "$place/.new" && mkdir -m 700 "$place/.new" && tar -x --no-same-owner -f - -C "$place/.new" ||
	die no-space "cannot write to $place"
for file in "$place"/.new/*; do
	cmp -s "$file" "$place/${file##*/}" || mv -fT "$file" "$place/${file##*/}" || die no-space "cannot write to $place"
done
rm -rf "$place/.new"
chown "$account:" "$state" && chown -R "$account:" "$place" || die account "cannot give $place to $account"
sync -f "$place"
cat "$place/id_ed25519.pub"
