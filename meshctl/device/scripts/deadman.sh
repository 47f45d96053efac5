#!/bin/sh
# meshctl-deadman: change a node's files so that every way out but a confirmation leads back to what was before.
#
#   lock -> stage -> arm -> apply -> confirm, or change -> confirm     (docs/device-scripts.md has the verbs and states)
#
# The state is the name of a marker file in flash, and every decision is one rename of it, which either happened or
# did not: `staged.ID` -> `armed.ID` -> `confirmed.ID` or `restoring.ID`. So confirm and the timer cannot both win, and
# after a power cut the marker alone says what to do. Content is synced before the rename that makes it count.
# Restoring moves the kept files back one by one: done twice, or half and then again, it ends the same, and it needs no
# free flash.
VERSION=14
SELF=/usr/sbin/meshctl-deadman
CHANGE=/etc/meshctl/change # flash: marker, manifest, reload, new/ (to come), prev/ and previous (to go back to), extra, last.*
LAST=/etc/meshctl/last     # flash: "ID OUTCOME REASON NONCE_SHA256" of the last change that ended
SNAPSHOT=/var/run/rpcd/snapshot-files # RAM: what rpcd copies back when its timer ends
RUN=/tmp/meshctl           # RAM: locks and timers; a reboot forgets them, as it should
SPARE_KIB=64               # flash that must stay free: uci, dropbear and jffs2's garbage collector write too
GUARD_GRACE_CS=3000        # the second timer fires 30 s after the first should have, or once that is gone
EXPIRE_GRACE_CS=1500       # an armed change that was not started ends so long after its owner's lock has
START_LIMIT_CS=1500        # a loaded radio starts a process within 15 s, or something is wrong with it
NEWLINE='
'
PROOF_S=3                  # what remains of the window when a reload stops waiting
RELOAD_TURN_CS=1000        # a restore waits so long for a reload under way, then stops it
EXTRA_LIMIT_CS=36000       # what else a change does (packages, into a slow jffs2) takes a minute or two
RESTORED_WAIT_CS=2000      # a new change waits so long for the reload of a rollback, then it is refused
RELOAD_LIMIT_CS=30000      # a reload of the restored state that takes over 300 s is stuck; then reboot

# by its path: a busybox that prefers its own applets would leave no way to stand in for it
sync() { /bin/sync; }

refuse() { echo "refused $1 $2"; exit 3; }

# answer TEXT: the verb's answer, unless it is a part of another verb
answer() { [ -n "$part" ] || echo "ok${1:+ $1}"; }

# NOW: centiseconds of uptime. The wall clock may be off by years or jump; this one only counts.
now() { read -r up _ </proc/uptime; NOW=$((${up%.*} * 100 + 1${up#*.} - 100)); }

exists() { [ -e "$1" ] || [ -L "$1" ]; }

hash_of() { sum=$(sha256sum <"$1") && echo "${sum%% *}"; }

word() { case $1 in '' | [!A-Za-z0-9]* | *[!A-Za-z0-9@._:+-]*) refuse usage "expected a word, found '$1'" ;; esac; }

number() { case $1 in '' | 0?* | *[!0-9]*) refuse usage "expected a number, found '$1'" ;; esac; }

# seconds TEXT: CS = centiseconds of "12", "12.3" or "12.34"
seconds() {
	case $1 in *.*) frac=${1#*.}00 ;; *) frac=00 ;; esac
	frac=1${frac%"${frac#??}"}
	number "${1%%.*}"
	number "$frac"
	CS=$((${1%%.*} * 100 + frac - 100))
}

# as_seconds CS: SECONDS_TEXT
as_seconds() { SECONDS_TEXT=$(($1 / 100)).$(($1 / 10 % 10))$(($1 % 10)); }

# --- lock: RUN/lock.N, the highest N counts. Each step makes the next N by hard link, which only one process can. ---

read_lock() {
	LOCK_N=0 LOCK_OWNER='' LOCK_LEFT=0
	for f in "$RUN"/lock.*; do
		[ -e "$f" ] && [ "${f##*.}" -gt "$LOCK_N" ] && LOCK_N=${f##*.}
	done
	[ "$LOCK_N" -gt 0 ] || return 0
	read -r LOCK_OWNER until boot 2>/dev/null <"$RUN/lock.$LOCK_N"
	read -r this_boot </proc/sys/kernel/random/boot_id
	now
	[ "$boot" = "$this_boot" ] && [ "$until" -gt "$NOW" ] && LOCK_LEFT=$((until - NOW)) && return 0
	LOCK_OWNER=''
}

write_lock() { # OWNER TTL_CS
	next=$((LOCK_N + 1))
	now
	read -r this_boot </proc/sys/kernel/random/boot_id
	line="$1 $((NOW + $2)) $this_boot"
	written=''
	echo "$line" 2>/dev/null >"$RUN/new.$$"
	read -r written 2>/dev/null <"$RUN/new.$$"
	# a lock that names nobody is none; that is what giving it back asks for
	[ "$written" = "$line" ] || [ "$2" -eq 0 ] || {
		rm -f "$RUN/new.$$"
		refuse tmp-full "no room in $RUN to write the lock"
	}
	ln "$RUN/new.$$" "$RUN/lock.$next" 2>/dev/null
	made=$?
	[ $made -eq 0 ] || { rm -f "$RUN/new.$$" && refuse locked "another process was faster"; }
	read_lock
	# a slow process may have read the directory before a winner tidied it, and so made a number that is too low
	[ "$LOCK_N" = $next ] || { rm -f "$RUN/new.$$" "$RUN/lock.$next" && refuse locked "another process was faster"; }
	old=$RUN/new.$$
	for f in "$RUN"/lock.*; do
		[ "${f##*.}" -ge $next ] || old="$old $f"
	done
	# shellcheck disable=SC2086 # names without blanks
	rm -f $old
}

need_lock() { # OWNER
	word "$1"
	read_lock
	[ "$LOCK_OWNER" = "$1" ] && return 0
	[ -n "$LOCK_OWNER" ] && refuse locked "held by $LOCK_OWNER for another $((LOCK_LEFT / 100)) s"
	refuse not-locked "take the lock first"
}

lock() { # OWNER TTL_S
	word "$1"
	number "$2"
	read_lock
	[ -z "$LOCK_OWNER" ] || need_lock "$1"
	held_before=$LOCK_OWNER
	write_lock "$1" $(($2 * 100))
	# what a meshctl that was killed has left of its uploads
	for f in "$RUN"/c[0-9a-f][0-9a-f]*[0-9a-f].tgz "$RUN"/.c[0-9a-f][0-9a-f]*.tgz.*.part; do
		[ "$LOCK_OWNER" = "$held_before" ] || [ ! -e "$f" ] || rm -f "$f"
	done
	answer "lock_owner=$1"
}

# keep_lock OWNER TTL_S: renews the lock when less than half of its time is left, or it has expired and nobody took it: a
# bundle may arrive slowly, and a flash that has to erase blocks first may take longer than the lock lasts
keep_lock() {
	read_lock
	[ -z "$LOCK_OWNER" ] || need_lock "$1"
	[ $LOCK_LEFT -gt $(($2 * 50)) ] || write_lock "$1" $(($2 * 100))
}

unlock() { # OWNER
	read_lock
	[ "$LOCK_OWNER" != "$1" ] || write_lock "$1" 0
	answer ''
}

# --- marker ---------------------------------------------------------------------------------------------------------

# read_marker: MARKER (idle, staged, armed, confirmed, restoring), what it holds, and TIMER, the change's files in RAM
read_marker() {
	MARKER=idle ID='' OWNER='' NONCE='' WINDOW=0
	for m in restoring confirmed armed staged; do
		for f in "$CHANGE/$m".*; do
			[ -f "$f" ] && MARKER=$m && read -r ID OWNER NONCE WINDOW <"$f" && break 2
		done
	done
	TIMER=$RUN/change-$ID
}

is_armed() { [ -f "$CHANGE/armed.$ID" ]; }

alive() { # PIDFILE: a process of ours still runs under that number
	read -r pid 2>/dev/null <"$1" || return 1
	# not by `read`, which reads byte by byte: halves of two command lines while the process is being started
	case $(cat "/proc/$pid/cmdline" 2>/dev/null) in
	*meshctl-deadman*) ;;
	# a process that is being started has no command line yet; a zombie has none any more
	'') grep -q '^State:[^Z]*$' "/proc/$pid/status" 2>/dev/null ;;
	*) return 1 ;;
	esac
}

# finish OUTCOME REASON: remember how it ended, then forget the change; the marker goes first, because a directory
# without one is rubbish to every verb
finish() {
	write_last "$1" "$2"
	sync
	forget "$1"
}

# write_arming DIRECTORY ID OWNER NONCE_SHA256 WINDOW_S: the marker to come, and the lines that become `last`: once the
# change is in force, its flash may be full, and an owner who has lost the answer would find no trace of the change
write_arming() {
	{
		echo "$2 $3 $4 $5" >"$1/arming" &&
			echo "$2 confirmed operator $4" >"$1/last.confirmed" &&
			echo "$2 restored unknown $4" >"$1/last.restored"
	} 2>/dev/null
}

# write_last OUTCOME REASON. Without room for it in flash the prepared line counts; half a line must not become the last one.
write_last() {
	if [ "$1" = confirmed ] && [ -s "$CHANGE/last.confirmed" ]; then
		# what a power cut has left of another change
		[ ! -e "$LAST.new" ] || rm -f "$LAST.new"
	else
		echo "$ID $1 $2 ${NONCE:--}" 2>/dev/null >"$LAST.new" || rm -f "$LAST.new"
	fi
}

# forget OUTCOME: `write_last` and what the marker decided are synced. A power cut in here leaves the marker, and the next
# verb ends the change once more, or only what is rubbish.
forget() {
	ending=$LAST.new
	[ -s "$ending" ] || ending=$CHANGE/last.$1
	[ ! -s "$ending" ] || mv -f "$ending" "$LAST"
	rm -f "$CHANGE"/*."$ID"
	rm -rf "$CHANGE" "$TIMER"
}

# tidy: complete what a killed process had decided, remove what one left half done
tidy() {
	read_marker
	case $MARKER in
	confirmed) finish confirmed operator && read_marker ;;
	idle) [ ! -e "$CHANGE" ] || rm -rf "$CHANGE" ;;
	esac
	for d in "$CHANGE".*; do
		[ ! -e "$d" ] || kill -0 "${d##*.}" 2>/dev/null || rm -rf "$d"
	done
}

# --- stage: build everything in a directory of this process, then rename it -----------------------------------------

# rpcd, when LuCI applies and nobody confirms, copies its snapshot over the files that it changed
no_foreign_changes() {
	changes=$(uci changes 2>/dev/null)
	[ -z "$changes" ] || refuse foreign-changes "uncommitted: $(echo "$changes" | tr '\n' ';')"
	for f in "$SNAPSHOT"/*; do
		[ ! -e "$f" ] || ! rpcd_waits ||
			refuse foreign-changes "rpcd waits for the confirmation of a change to ${f##*/} (LuCI: Save & Apply)"
	done
}

# rpcd_waits: 1 if rpcd has no timer, or does not run. A snapshot alone is no sign: "Apply unchecked" leaves one,
# too. To confirm under a name that is no session's changes nothing; the answer's number differs between versions of ubus.
rpcd_waits() {
	case $(ubus -t 5 call uci confirm '{"ubus_rpc_session":"meshctl"}' 2>&1) in
	*'No response'* | *'Not found'*) return 1 ;;
	esac
}

# Else a timer of rpcd that began in the window would bring back, after the restore, what the change had put there.
into_snapshot() { # PATH, of what is about to be restored
	[ -e "$SNAPSHOT/${1##*/}" ] && [ "$1" = "/etc/config/${1##*/}" ] || return 0
	# rpcd skips names with a dot, and removes them with the others
	cp "$CHANGE/prev$1" "$SNAPSHOT/.meshctl" && mv -f "$SNAPSHOT/.meshctl" "$SNAPSHOT/${1##*/}"
}

# kib_free DIRECTORY: FREE, of the last line of df, because a long device name breaks its row in two
kib_free() {
	FREE=''
	while read -r a b c d e f; do
		if [ -n "$f" ]; then FREE=$d; elif [ -n "$e" ]; then FREE=$c; fi
	done <<-END
		$(df -k "$1" 2>/dev/null)
	END
}

check_space() { # BUNDLE: its manifest, and that there is room for it and for what it will replace
	kib_free "${CHANGE%/*}"
	need=$((SPARE_KIB + $(gzip -dc "$1" | wc -c) / 1024 + 1))
	old=''
	while read -r _ _ _ _ path; do
		[ -z "$path" ] || check_path "$path" || refuse bad-path "$BAD_PATH"
		[ ! -f "$path" ] || old="$old $path"
	done <<-END
		$(tar -xzOf "$1" manifest 2>/dev/null)
	END
	# shellcheck disable=SC2086 # paths have no blanks, see check_path
	[ -z "$old" ] || while read -r size of; do [ "$of" = total ] || need=$((need + size / 1024 + 1)); done <<-END
		$(wc -c $old)
	END
	case $FREE in '' | *[!0-9]*) return 0 ;; esac
	[ "$FREE" -ge "$need" ] || refuse flash-full "needs $need KiB of flash, $FREE KiB are free"
}

check_path() { # PATH: 1, and why in BAD_PATH, where it cannot be covered
	BAD_PATH=$1
	case $1 in
	*[!A-Za-z0-9._/+@-]* | *//* | */../* | */./* | */. | */.. | */) return 1 ;;
	/etc/meshctl/change* | /etc/meshctl/last* | /tmp/* | /var/* | /dev/* | /proc/* | /sys/*) BAD_PATH="$1 is not kept in flash, or is ours" && return 1 ;;
	/*/*) [ ! -d "$1" ] || { BAD_PATH="$1 is a directory" && return 1; } ;;
	*) return 1 ;;
	esac
}

# sums_hold SUMS: lines of `SHA256  PATH`, all of which are right; one process for all files
sums_hold() {
	[ -z "$1" ] || sha256sum -c >/dev/null 2>&1 <<-END
		$1
	END
}

was_as_expected() { # DIRECTORY: every live file is what the plan saw; if not, MOVED_ON is one that differs
	sums=''
	while read -r _ _ _ expected MOVED_ON; do
		case $expected in
		-) ;;
		absent) ! exists "$MOVED_ON" || return 1 ;;
		*) [ -f "$MOVED_ON" ] && sums="$sums${sums:+$NEWLINE}$expected  $MOVED_ON" || return 1 ;;
		esac
	done <"$1/manifest"
	sums_hold "$sums" && return 0
	while read -r _ _ _ expected MOVED_ON; do
		case $expected in
		- | absent) ;;
		*) [ "$(hash_of "$MOVED_ON")" = "$expected" ] || return 1 ;;
		esac
	done <"$1/manifest"
}

# copy_kept DIRECTORY: copies the files FROM of the directory AT to prev/
copy_kept() {
	[ -n "$FROM" ] || return 0
	[ -d "$1/prev$AT" ] || mkdir -p "$1/prev$AT" || return 1
	# shellcheck disable=SC2086 # paths have no blanks, see check_path
	cp -a $FROM "$1/prev$AT/"
}

# keep_previous DIRECTORY: copies what the manifest names to prev/, with one process for each directory; what to do with
# each file goes to `previous`, the sums of the copies, by the live paths, to `kept`
keep_previous() {
	FROM='' AT='' files=''
	while read -r _ _ _ _ path; do
		dir=${path%/*}
		if exists "$path"; then
			[ "$dir" = "$AT" ] || { copy_kept "$1" && AT=$dir FROM=''; } || return 1
			FROM="$FROM $path"
			[ -L "$path" ] || files="$files .$path"
			echo "had $path" || return 1
			continue
		fi
		echo "not $path" || return 1
		while [ -n "$dir" ] && [ ! -d "$dir" ]; do
			echo "dir $dir" || return 1
			dir=${dir%/*}
		done
	done <"$1/manifest" >"$1/previous" || return 1
	copy_kept "$1" && : >"$1/kept" || return 1
	# shellcheck disable=SC2086
	[ -z "$files" ] || (cd "$1/prev" && sha256sum $files) >"$1/kept"
}

check_new() { # DIRECTORY: every new file is there, whole
	sums=''
	while read -r kind _ is _ path; do
		case $kind in
		file) sums="$sums${sums:+$NEWLINE}$is  $1/new$path" ;;
		link) [ "$(readlink "$1/new$path")" = "$is" ] ;;
		esac || return 1
	done <"$1/manifest"
	sums_hold "$sums"
}

unchanged_since_kept() { # DIRECTORY: what is live is what was kept
	while read -r kind path; do
		case $kind in
		had) [ ! -L "$path" ] && [ ! -L "$1/prev$path" ] || [ "$(readlink "$path")" = "$(readlink "$1/prev$path")" ] ;;
		not) ! exists "$path" ;;
		esac || return 1
	done <"$1/previous"
	[ -f "$1/kept" ] || return 1
	[ ! -s "$1/kept" ] || (cd / && sha256sum -c) <"$1/kept" >/dev/null 2>&1
}

drop() { # DIRECTORY CODE TEXT
	rm -rf "$1"
	refuse "$2" "$3"
}

# At the first boot / is RAM until jffs2 is ready, and what is copied into it then may lack what was written meanwhile
# (fstools, overlay.c and mount.c name that mount so). An initramfs image has no flash below / at all: procd says so in
# `rootfs_type` (22.03 on) or as `"initramfs": true` (21.02); up to 19.07 / is the kernel's rootfs. The last mount on /
# is the one in use.
in_flash() {
	root=
	while read -r device at _; do
		[ "$at" != / ] || root=$device
	done </proc/mounts
	case $root in overlayfs:/tmp/root | rootfs) return 1 ;; esac
	case $(ubus call system board 2>/dev/null) in *'"initramfs"'*) return 1 ;; esac
}

# An armed change that was not started has changed nothing. It ends once its owner has lost the lock.
end_abandoned() { # the lock is ours to judge by: whoever has it now, it is not the change's owner
	[ "$MARKER" = armed ] && [ ! -e "$TIMER/due" ] && [ "$LOCK_OWNER" != "$OWNER" ] || return 0
	restore expired
	read_marker
}

# Each boot unpacks the archive that sysupgrade kept or was given (preinit), until one of them gets to its last init script
# (S95 done), which deletes it. Logins work much earlier, and a power cut before that would undo even a confirmed change.
is_first_boot() { [ -e /sysupgrade.tgz ]; }

stage() { # OWNER ID BUNDLE [NONCE_SHA256 WINDOW_S]: with the last two, `arm_staged` needs no more writing
	need_lock "$1"
	word "$2"
	in_flash || refuse no-flash "/ is in RAM: wait until its flash is ready, some minutes after the first boot; an initramfs image has none"
	! is_first_boot || refuse no-flash "its first boot after a flash has not ended, and the next boot would unpack /sysupgrade.tgz over the change: try again in a minute"
	tidy
	end_abandoned
	case $MARKER in armed | restoring) refuse busy "change $ID of $OWNER is $MARKER" ;; esac
	await_restored
	# `change` has just compared its sum
	{ [ -f "$3" ] && { [ -n "$part" ] || gzip -t "$3" 2>/dev/null; }; } || refuse bad-bundle "$3 is missing or damaged"
	no_foreign_changes
	[ ! -e "$CHANGE" ] || rm -rf "$CHANGE"
	check_space "$3"
	w=$CHANGE.$$
	mkdir -p "$w/new" "$w/prev" || drop "$w" flash-full "cannot make $w"
	tar -xzf "$3" -C "$w" 2>/dev/null || drop "$w" flash-full "the bundle did not unpack"
	{ [ -f "$w/manifest" ] && [ -f "$w/reload" ]; } || drop "$w" bad-bundle "no manifest or reload in it"
	check_new "$w" || drop "$w" flash-full "what was unpacked is not what was sent"
	was_as_expected "$w" || drop "$w" moved-on "$MOVED_ON is not what the plan saw"
	while read -r kind _ _ _ path; do
		# a link that led to a directory would let a later mv put its file in there
		case $kind$path in link/etc/rc.d/* | file/* | remove/* | cover/*) ;; *) drop "$w" bad-path "$kind $path" ;; esac
	done <"$w/manifest"
	keep_previous "$w" || drop "$w" flash-full "could not keep the previous files"
	extra keep "$w" || drop "$w" flash-full "could not read the new packages, or not keep those that they replace"
	unchanged_since_kept "$w" || drop "$w" flash-full "what was kept is not what is there"
	for conf in "$w"/new/etc/config/*; do
		[ ! -f "$conf" ] || uci -c "$w/new/etc/config" show "${conf##*/}" >/dev/null 2>&1 ||
			drop "$w" bad-uci "uci cannot read the new ${conf##*/}"
	done
	{ echo "$2 $1 - 0" 2>/dev/null >"$w/ready" && write_arming "$w" "$2" "$1" "${4:--}" "${5:-0}"; } ||
		drop "$w" flash-full "could not write the marker"
	# Everything is in flash before the renames that make it count; only the last one makes it a stage: where a directory
	# cannot be renamed, mv copies, and may be cut short. A stage that a power cut takes is sent again.
	{ sync && mv "$w" "$CHANGE" && mv "$CHANGE/ready" "$CHANGE/staged.$2"; } ||
		drop "$w" flash-full "could not put the stage in place"
	answer "state=staged id=$2"
}

# --- arm, apply, confirm, abort -------------------------------------------------------------------------------------

arm() { # OWNER ID NONCE_SHA256 WINDOW_S
	need_lock "$1"
	word "$3"
	number "$4"
	tidy
	if [ "$MARKER $ID $OWNER $NONCE $WINDOW" != "armed $2 $1 $3 $4" ]; then
		[ "$MARKER $ID" = "staged $2" ] || refuse wrong-state "change ${ID:--} is $MARKER, expected $2 staged"
		{ [ -L /etc/rc.d/S05meshctl-deadman ] && [ -x /etc/init.d/meshctl-deadman ]; } ||
			refuse not-enabled "the boot hook is missing: a power cut would not be undone"
		# `change` has just done all this
		[ -n "$part" ] || {
			no_foreign_changes
			check_new "$CHANGE" || refuse bad-bundle "a staged file is damaged; stage again"
			unchanged_since_kept "$CHANGE" || refuse moved-on "a file changed since it was staged"
			{ write_arming "$CHANGE" "$2" "$1" "$3" "$4" && sync; } || refuse flash-full "could not write the marker"
		}
		[ ! -e "$TIMER" ] || rm -rf "$TIMER"
		mv -f "$CHANGE/arming" "$CHANGE/armed.$2" || refuse flash-full "could not write the marker"
		rm -f "$CHANGE/staged.$2"
		sync
		read_marker
		detach expire "$2" $((NOW + LOCK_LEFT + EXPIRE_GRACE_CS))
	fi
	answer "state=armed id=$2"
}

detach() { # NAME ARGS: a process of its own session, which no closing connection takes along
	[ -d "$TIMER" ] || mkdir -p "$TIMER"
	start-stop-daemon -S -q -b -m -p "$TIMER/$1.pid" -x "$SELF" -- "$@"
}

apply() { # OWNER ID now | in SECONDS | at UPTIME_SECONDS
	tidy
	[ "$MARKER $ID $OWNER" = "armed $2 $1" ] || refuse wrong-state "change ${ID:--} of ${OWNER:--} is $MARKER"
	[ ! -e "$TIMER/due" ] || refuse busy "change $ID was already started"
	now
	case $3 in
	now) due=$NOW ;;
	in) seconds "$4" && due=$((NOW + CS)) ;;
	at) seconds "$4" && due=$CS ;;
	*) refuse usage "expected now, in or at" ;;
	esac
	[ $due -ge $NOW ] || refuse too-late "uptime $4 is $((NOW - due)) hundredths of a second ago"
	detach guard "$ID" $due
	detach watch "$ID" $due
	limit=$((NOW + START_LIMIT_CS))
	until [ -e "$TIMER/due" ]; do
		if ! is_armed; then
			# it has ended before this process looked
			read -r _ last_outcome _ 2>/dev/null <"$LAST"
			[ "$last_outcome" != refused ] || refuse moved-on "a file changed since it was staged"
			break
		fi
		# should it start after all, it finds the abort and changes nothing
		now && [ $NOW -lt $limit ] || { : >"$TIMER/abort" && refuse no-watcher "the timer did not start in time"; }
		doze
	done
	as_seconds $due
	answer "state=waiting id=$ID due_uptime_s=$SECONDS_TEXT"
}

# change: all of the above in one process, for one answer when the reload has ended, or LIMIT_S later. A cut connection
# stops nothing from `arm` on; before it, nothing has changed.
change() { # OWNER TTL_S ID NONCE_SHA256 WINDOW_S LIMIT_S BUNDLE_SHA256: the bundle on standard input
	word "$3"
	word "$4"
	number "$5"
	number "$6"
	part=yes
	lock "$1" "$2"
	bundle=$RUN/$3.tgz
	trap 'rm -f "$bundle"' EXIT
	cat 2>/dev/null >"$bundle" || refuse tmp-full "no room in $RUN for the bundle"
	[ "$(hash_of "$bundle")" = "$7" ] || refuse bad-bundle "the bundle was damaged on the way"
	keep_lock "$1" "$2"
	stage "$1" "$3" "$bundle" "$4" "$5"
	rm -f "$bundle"
	trap - EXIT
	keep_lock "$1" "$2"
	arm "$1" "$3" "$4" "$5"
	apply "$1" "$3" now
	now
	limit=$((NOW + $6 * 100))
	until { [ -e "$TIMER/applied" ] && [ -e "$RUN/reloaded" ]; } || ! is_armed || { now && [ $NOW -ge $limit ]; }; do pause 1; done
	reloaded=''
	[ ! -e "$TIMER/applied" ] || read -r reloaded 2>/dev/null <"$RUN/reloaded"
	part=''
	answer "id=$3 reload_status=$reloaded"
}

# nap CS: the end of a countdown; where sleep knows no fractions it returns at once and its caller spins for a moment
nap() {
	as_seconds "$1"
	sleep "$SECONDS_TEXT" 2>/dev/null || :
}

doze() { sleep 0.2 2>/dev/null || sleep 1; }

# pause SECONDS: a sleep without a process of its own, which a slow processor would have to start every second: nothing is
# ever written into the FIFO
pause() {
	[ -p "$RUN/pause" ] || mkfifo "$RUN/pause" 2>/dev/null
	if [ -p "$RUN/pause" ]; then
		read -r -t "$1" _ <>"$RUN/pause" 2>/dev/null
		# 1: the time is over; more: this shell's read knows no time limit
		[ $? -le 1 ] || sleep "$1"
	else
		sleep "$1"
	fi
}

# extra VERB DIRECTORY: what else a change does and undoes besides files; says nothing, since sessions read our answers
extra() { [ ! -f "$2/extra" ] || sh "$2/extra" "$1" "$2" >"$RUN/extra.log" 2>&1; }

# why_failed: REASON, of what the packages' tool said: apk repeats the system's error, opkg looks before it begins
why_failed() {
	reason=failed
	[ ! -f "$CHANGE/extra" ] || ! grep -q -e 'No space left' -e 'Only have .* available' "$RUN/extra.log" || reason=flash-full
}

# move_new: moves the files FROM into the directory AT
move_new() {
	[ -n "$FROM" ] || return 0
	[ -d "$AT" ] || mkdir -p "$AT" || return 1
	# shellcheck disable=SC2086 # paths have no blanks, see check_path
	mv -f $FROM "$AT/"
}

put_new() {
	extra do "$CHANGE" || return 1
	FROM='' AT=''
	while read -r kind _ _ _ path; do
		case $kind in
		file | link)
			[ "${path%/*}" = "$AT" ] || { move_new && AT=${path%/*} FROM=''; } || return 1
			FROM="$FROM $CHANGE/new$path"
			;;
		remove) rm -f "$path" ;;
		esac || return 1
	done <"$CHANGE/manifest"
	move_new && sync
}

# moved back, not copied: atomic for each file, and a full flash cannot stop it; what frees flash comes first
put_previous() {
	# it cannot stop the way back of the files: what stays is told
	extra undo "$CHANGE" || stays=+packages-stay
	rm -rf "$CHANGE/new"
	while read -r kind path; do
		case $kind in
		not)
			case $path in /etc/config/*) rm -f "$SNAPSHOT/${path##*/}" ;; esac
			rm -f "$path"
			;;
		dir) rmdir "$path" 2>/dev/null ;;
		esac
	done <"$CHANGE/previous"
	left=0
	while read -r kind path; do
		[ "$kind" = had ] && exists "$CHANGE/prev$path" || continue
		[ -d "${path%/*}" ] || mkdir -p "${path%/*}"
		into_snapshot "$path"
		mv -f "$CHANGE/prev$path" "$path"
		! exists "$CHANGE/prev$path" || left=1
	done <"$CHANGE/previous"
	sync
	return $left
}

# wait_until CS: 1 when the change is no longer ours to end
wait_until() {
	while now && [ $NOW -lt "$1" ]; do
		is_armed || return 1
		[ ! -e "$TIMER/abort" ] || return 0
		left=$(($1 - NOW))
		if [ $left -gt 150 ]; then pause 1; elif [ $left -gt 50 ]; then nap $((left - 40)); else nap $left; fi
	done
	is_armed
}

# Held in the shell: the change may be forgotten before it runs, and of a copy in a full /tmp only a part might, or nothing.
reload() { # SCRIPT_TEXT [UPTIME_S]: in the background, so that no hanging reload holds up the timer; its waits end then
	rm -f "$RUN/reloaded"
	(
		UNTIL_S=$2 sh -c "${1:-exit 1}" >"$RUN/reload.log" 2>&1 &
		echo $! >"$RUN/reload.pid"
		wait $!
		echo $? >"$RUN/reloaded"
	) &
	reload_pid=$!
	echo $reload_pid 2>/dev/null >"$RUN/reload.waits"
}

# Two of reload_config at once take each other's list of sums away, and then tell no service of what changed.
# The one under way may have been begun by a timer that was killed since.
end_reload() {
	[ -n "$reload_pid" ] || ! alive "$RUN/reload.waits" || reload_pid=$pid
	[ -n "$reload_pid" ] || return 0
	now
	limit=$((NOW + RELOAD_TURN_CS))
	until [ -e "$RUN/reloaded" ] || { now && [ $NOW -ge $limit ]; }; do doze; done
	[ ! -e "$RUN/reloaded" ] || return 0
	read -r script_pid 2>/dev/null <"$RUN/reload.pid"
	# the shell around it first, which would report its end
	kill "$reload_pid" "$script_pid" 2>/dev/null
}

# A restore ends the change before its reload has ended: another change would share the status of that reload.
is_reloading() { alive "$RUN/restoring"; }

await_restored() {
	now
	limit=$((NOW + RESTORED_WAIT_CS))
	while is_reloading; do
		now && [ $NOW -lt $limit ] || refuse busy "services are still reloading after a rollback; try again in a minute"
		doze
	done
}

# restore REASON: the marker's rename decides who does it; nothing happens when the change was confirmed meanwhile
restore() {
	mv "$CHANGE/armed.$ID" "$CHANGE/restoring.$ID" 2>/dev/null || [ -f "$CHANGE/restoring.$ID" ] || return 0
	sync
	reload_script=$(cat "$CHANGE/reload") reload_it=no stays=''
	[ ! -e "$TIMER/applied" ] || reload_it=yes
	put_previous || return 0 # the marker stays: abort, the second timer and the next boot try again
	[ $reload_it = no ] || echo $$ 2>/dev/null >"$RUN/restoring"
	finish restored "$1$stays"
	[ $reload_it = yes ] || return 0
	end_reload
	reload "$reload_script"
	now
	limit=$((NOW + RELOAD_LIMIT_CS))
	until [ -e "$RUN/reloaded" ] || { now && [ $NOW -ge $limit ]; }; do doze; done
	read -r status 2>/dev/null <"$RUN/reloaded"
	rm -f "$RUN/restoring"
	# the boot path is the one that is known to bring the restored state up
	[ "$status" = 0 ] || /sbin/reboot
}

unkillable() { echo -1000 2>/dev/null >/proc/self/oom_score_adj; }

# applied_at_now: from here on a restore has to reload as well
applied_at_now() { now && mkdir -p "$TIMER" && echo $NOW >"$TIMER/applied"; }

watch() { # ID DUE_CS: detached
	unkillable
	read_marker
	[ "$MARKER $ID" = "armed $1" ] || exit 0
	echo "$2" >"$TIMER/due"
	wait_until "$2" || exit 0
	if [ -e "$TIMER/abort" ]; then
		restore abort
	elif ! unchanged_since_kept "$CHANGE"; then
		# somebody's edit would be overwritten, and restoring would overwrite it too: leave everything as it is
		mv "$CHANGE/armed.$ID" "$CHANGE/staged.$ID" && finish refused moved-on
	elif ! put_new; then
		applied_at_now
		why_failed
		restore $reason
	else
		# a reload that is not done by then would run at once with the one of the restore
		now
		reload "$(cat "$CHANGE/reload")" $((NOW / 100 + WINDOW - PROOF_S))
		applied_at_now
		wait_until $((NOW + WINDOW * 100)) || exit 0
		reason=timeout
		[ ! -e "$TIMER/abort" ] || reason=abort
		restore $reason
	fi
}

guard() { # ID DUE_CS: detached; ends the change if `watch` was killed
	unkillable
	read_marker
	[ "$ID" = "$1" ] || exit 0
	limit=$(($2 + WINDOW * 100 + GUARD_GRACE_CS))
	[ ! -f "$CHANGE/extra" ] || limit=$((limit + EXTRA_LIMIT_CS))
	while now && is_armed && { [ $NOW -lt $limit ] || is_watched "$2"; }; do
		if [ $((limit - NOW)) -gt 0 ] && [ $((limit - NOW)) -le 500 ]; then pause 1; else pause 4; fi
	done
	while [ -f "$CHANGE/restoring.$ID" ] && alive "$TIMER/watch.pid"; do pause 1; done
	{ is_armed || [ -f "$CHANGE/restoring.$ID" ]; } || exit 0
	applied_at_now
	restore guard
}

# is_watched DUE_CS: `watch` runs and its time is not over. Its window begins when the files are in place, which takes a
# loaded node with a slow flash longer than the grace.
is_watched() {
	alive "$TIMER/watch.pid" || return 1
	read -r began 2>/dev/null <"$TIMER/applied" || began=$(($1 + EXTRA_LIMIT_CS))
	[ $NOW -lt $((began + WINDOW * 100 + GUARD_GRACE_CS)) ]
}

expire() { # ID DUE_CS: detached; ends a change that its owner armed and never started, once it has lost the lock
	read_marker
	[ "$ID" = "$1" ] || exit 0
	while [ ! -e "$TIMER/due" ]; do
		is_armed || exit 0
		now
		[ $NOW -lt "$2" ] || break
		if [ $(($2 - NOW)) -gt 500 ]; then pause 3; else pause 1; fi
	done
	read_lock
	# started, or its owner has renewed the lock and decides
	[ ! -e "$TIMER/due" ] && [ "$LOCK_OWNER" != "$OWNER" ] || exit 0
	# should it be started at this moment, it finds the abort and changes nothing
	: >"$TIMER/abort"
	sleep 2
	[ ! -e "$TIMER/due" ] || exit 0
	restore expired
}

orphan() { # ID: detached; takes a change back whose timer is gone
	unkillable
	read_marker
	[ "$ID" = "$1" ] && applied_at_now && restore abort
}

confirm() { # ID NONCE [OWNER]: with OWNER, gives its lock back
	given=$(printf %s "$2" | sha256sum)
	tidy
	read -r last_id last_outcome last_reason last_nonce 2>/dev/null <"$LAST"
	if [ "$last_id $last_nonce" = "$1 ${given%% *}" ] && [ "$ID" != "$1" ]; then
		# an answer was lost on the way; say again what became of it
		[ "$last_outcome" = confirmed ] || refuse restored "change $1 was $last_outcome ($last_reason)"
	else
		[ "$MARKER $ID" = "armed $1" ] || refuse wrong-state "change ${ID:--} is $MARKER, expected $1 applied"
		[ "$NONCE" = "${given%% *}" ] || refuse wrong-nonce "this is not the nonce change $1 was armed with"
		[ -e "$TIMER/applied" ] || refuse not-applied "change $ID is not applied yet"
		write_last confirmed operator
		mv "$CHANGE/armed.$ID" "$CHANGE/confirmed.$ID" 2>/dev/null || refuse restored "the window has just run out"
		sync
		forget confirmed
	fi
	[ -z "$3" ] || { part=yes && unlock "$3" && part=''; }
	answer "state=idle id=$1 outcome=confirmed"
}

abort() { # OWNER ID
	tidy
	[ "$ID" = "$2" ] || refuse wrong-state "change ${ID:--} is $MARKER"
	[ "$OWNER" = "$1" ] || need_lock "$1"
	if [ "$MARKER" = staged ]; then
		finish aborted operator
	elif [ ! -e "$TIMER/due" ] && [ "$MARKER" = armed ]; then
		restore abort
	elif alive "$TIMER/watch.pid"; then
		: >"$TIMER/abort"
	else
		detach orphan "$ID"
	fi
	read_marker
	echo "ok state=$MARKER id=$2"
}

# --- boot, status ---------------------------------------------------------------------------------------------------

boot() { # before anything reads the configuration, so nothing is reloaded
	rm -rf "$RUN"/*
	tidy
	# for packages.sh
	export BOOTING=yes
	put_back=no
	[ ! -s "$CHANGE/packages.begun" ] || put_back=yes
	case $MARKER in armed | restoring) restore boot ;; *) return 0 ;; esac
	# services that came back with their packages were not there when the list of what to start was made
	[ $put_back = no ] || [ -e "$CHANGE" ] || /sbin/reboot
}

status() {
	read_marker
	read_lock
	read -r last_id last_outcome last_reason _ 2>/dev/null <"$LAST"
	read -r reloaded 2>/dev/null <"$RUN/reloaded"
	now
	state=$MARKER left='' due='' reloading=no
	! is_reloading || reloading=yes
	if [ "$MARKER" = armed ] && read -r due 2>/dev/null <"$TIMER/due"; then
		state=waiting
		as_seconds "$due"
		due=$SECONDS_TEXT
		read -r applied 2>/dev/null <"$TIMER/applied" && state=applied left=$(((applied - NOW) / 100 + WINDOW))
		alive "$TIMER/watch.pid" || state=orphaned
	fi
	as_seconds $NOW
	echo "version=$VERSION state=$state id=$ID owner=$OWNER window_s=$WINDOW left_s=$left due_uptime_s=$due" \
		"reload_status=$reloaded lock_owner=$LOCK_OWNER lock_left_s=$((LOCK_LEFT / 100))" \
		"last_id=$last_id last_outcome=$last_outcome last_reason=$last_reason uptime_s=$SECONDS_TEXT" \
		"restored_reload=$reloading"
}

umask 022
[ -d "$RUN" ] && [ -d "${CHANGE%/*}" ] || mkdir -p -m 700 "$RUN" "${CHANGE%/*}"
verb=$1
[ $# -eq 0 ] || shift
case $verb in
lock | unlock | stage | arm | apply | change | watch | guard | expire | orphan | confirm | abort | boot | status) "$verb" "$@" ;;
*) refuse usage "unknown verb '$verb'" ;;
esac
