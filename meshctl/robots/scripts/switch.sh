# switch ID HOW WAIT: makes a release the current one, and goes back to the one before unless it proves itself healthy
# within WAIT seconds. HOW is `restart`, or `reload` where only the configuration differs: then nothing that the daemon
# holds is lost. Runs to its end even if the operator's link breaks. Prints `result=...`, then why, then the last log.
id=$1 how=$2 wait_s=$3
trap '' HUP INT PIPE
alone
[ -d "$root/releases/$id" ] || die no-release "release $id is not installed here"
was=$(release_of current)
# a switch that was cut short has proved nothing: what ran before it is still what to go back to
[ ! -e "$root/unproven" ] || read -r was <"$root/unproven" || was=

# names KEY: the names of JSON objects whose KEY is true (udp-mesh prints one field a line, the name first).
names() {
	awk -F'"' -v key="$1" '$2 == "name" { name = $4 } $2 == key && $3 ~ /true/ { print name }'
}

peers() { mesh peers --json 2>/dev/null | names online | sort; }

field() { awk -F'"' -v key="$1" '$2 == key { print $4; exit }'; }

# bring HOW: lets the current release run.
bring() {
	cp "$root/current/$unit" "$unit_file.new" && mv -f "$unit_file.new" "$unit_file" || return 1
	systemctl daemon-reload && systemctl enable "$unit" >/dev/null 2>&1 || return 1
	if [ "$1" = reload ] && systemctl is-active "$unit" >/dev/null 2>&1 && changes=$(mesh reload 2>&1); then
		case $changes in *"takes effect with the next start"*) ;; *) return 0 ;; esac
	fi
	systemctl reset-failed "$unit" 2>/dev/null
	systemctl restart "$unit"
}

# ill: one line on what keeps the daemon from being well; nothing when it is.
ill() {
	[ "$(systemctl is-active "$unit" 2>/dev/null)" = active ] || { echo "the daemon does not run"; return; }
	status=$(mesh status --json 2>&1) || { echo "the daemon does not answer: $status"; return; }
	boot=$(echo "$status" | field boot)
	[ "$boot" = "$seen_boot" ] || { seen_boot=$boot; echo "the daemon has only just started"; return; }
	topics=$(mesh topics --json 2>/dev/null | names configured)
	while read -r topic; do
		echo "$topics" | grep -qxF -e "$topic" || { echo "topic $topic is not there"; return; }
	done <"$root/current/topics"
	online=$(peers)
	for peer in $before; do
		echo "$online" | grep -qxF -e "$peer" || { echo "peer $peer was online before and is not seen"; return; }
	done
}

# prove WAIT: whether the daemon is well within so long; `reason` tells why not. Two looks have to see the same process.
prove() {
	left=$1 seen_boot=
	while :; do
		# not in a subshell, which would forget the process it saw
		ill >"$root/.ill"
		read -r reason <"$root/.ill" || reason=
		[ -n "$reason" ] || { rm -f "$root/.ill"; return 0; }
		[ "$left" -gt 0 ] || { rm -f "$root/.ill"; return 1; }
		left=$((left - 1))
		sleep 1
	done
}

# what is gone with the last release that used it
tidy() {
	keep=" $(release_of current) $(release_of previous) "
	for release in "$root"/releases/*; do
		case $keep in *" ${release##*/} "*) ;; *) rm -rf "$release" ;; esac
	done
	used=" $(for link in "$root"/releases/*/lib; do basename "$(readlink "$link")"; done | tr '\n' ' ')"
	for tree in "$root"/trees/*; do
		case $used in *" ${tree##*/} "*) ;; *) rm -rf "$tree" ;; esac
	done
	for wheel in "$root"/wheels/*; do
		grep -qF " ${wheel##*/}" "$root"/releases/*/wheels 2>/dev/null || rm -f "$wheel"
	done
	rm -f "$root"/wheels/.*.part
}

before=$(peers)
echo "$was" >"$root/unproven" && sync
point current "$id" || die no-space "cannot change $root/current"
if bring "$how" && prove "$wait_s"; then
	[ -z "$was" ] || [ "$was" = "$id" ] || point previous "$was"
	rm -f "$root/unproven"
	tidy
	sync
	echo "result=switched"
	echo "online=$(echo $(peers))"
	exit 0
fi
[ -n "${reason:-}" ] || reason="systemd could not start the daemon"
log=$(journalctl -u "$unit" -n 12 --no-pager -o cat 2>/dev/null | sed 's/^/log=/')

if [ -n "$was" ] && [ "$was" != "$id" ] && [ -d "$root/releases/$was" ]; then
	point current "$was"
	if bring "$how" && reason_before=$reason && prove "$wait_s"; then
		echo "result=rolled-back"
	else
		echo "result=rolled-back-ill"
	fi
	reason=${reason_before:-$reason}
	rm -f "$root/unproven"
	rm -rf "$root/releases/$id"
elif [ -z "$was" ]; then
	systemctl disable --now "$unit" >/dev/null 2>&1
	rm -f "$unit_file" "$root/current" "$root/unproven"
	rm -rf "$root/releases/$id"
	systemctl daemon-reload
	echo "result=removed"
else
	echo "result=ill"
fi
sync
echo "reason=$reason"
echo "$log"
