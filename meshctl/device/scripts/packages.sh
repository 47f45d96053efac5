# The package part of a change, run by meshctl-deadman: `sh extra keep|do|undo DIRECTORY`. Sent with TOOL (opkg or apk),
# FILES (package files) and REMOVE (conflicting packages, removed first) set before it. DIRECTORY belongs to the change
# and is in flash: `keep` saves there what `undo` needs, so a power cut during `do` is rolled back, too.
verb=$1
dir=$2

installed() {
	case $TOOL in
	apk) sed -n 's/^P://p' /lib/apk/db/installed ;;
	*) awk '/^Package:/ { name = $2 } /^Status:/ && $NF != "not-installed" { print name }' /usr/lib/opkg/status ;;
	esac
}

added() { installed | grep -vxF -f "$dir/packages.before"; }

files_of() { # PACKAGE: without the leading slash
	case $TOOL in
	apk) apk info -L "$1" | sed '/ contains:$/d; s|^/||' ;;
	*) opkg files "$1" | sed -n 's|^/||p' ;;
	esac 2>/dev/null
}

# the files that restore a removed package: its own, its rc.d links, the package manager's database
to_keep() {
	for package in $REMOVE; do
		files_of "$package" | while read -r file; do
			echo "$file"
			case $file in etc/init.d/*) for link in /etc/rc.d/[SK][0-9][0-9]"${file##*/}"; do echo "${link#/}"; done ;; esac
		done
		for file in "/usr/lib/opkg/info/$package".*; do echo "${file#/}"; done
	done
	printf '%s\n' usr/lib/opkg/status lib/apk/db/installed lib/apk/db/scripts.tar lib/apk/db/scripts.tar.gz etc/apk/world
}

keep() {
	installed >"$dir/packages.before" && [ -s "$dir/packages.before" ] || return 1
	[ -n "$REMOVE" ] || return 0
	cd / || return 1
	set --
	for file in $(to_keep); do
		if [ -f "$file" ] || [ -L "$file" ]; then set -- "$@" "$file"; fi
	done
	tar -cf "$dir/packages.tar" "$@" && tar -tf "$dir/packages.tar" >/dev/null
}

do_it() {
	# shellcheck disable=SC2086 # words are paths and names without blanks
	case $TOOL in
	apk)
		[ -z "$REMOVE" ] || apk del --no-network $REMOVE || return 1
		# package files are verified by meshctl's hash, not by a repository key
		apk add --no-network --allow-untrusted $FILES || return 1
		;;
	*)
		[ -z "$REMOVE" ] || opkg remove $REMOVE || return 1
		opkg install $FILES || return 1
		;;
	esac
	# free the memory
	rm -f $FILES
}

undo() {
	[ -f "$dir/packages.before" ] || return 0
	# for opkg's lock: at boot this runs before the script that creates the directory
	mkdir -p /var/lock
	new=$(added | tr '\n' ' ')
	# shellcheck disable=SC2086
	case $TOOL$new in
	apk?*) apk del --no-network $new ;;
	opkg?*) opkg remove --force-depends $new ;;
	esac
	[ -z "$(added)" ] || return 1
	for package in $REMOVE; do
		installed | grep -qxF "$package" || { tar -xf "$dir/packages.tar" -C / && start_again && return; }
	done
}

# Starts the services of restored packages, which would otherwise start only at the next boot. Not during boot, because
# the node is about to reboot.
start_again() {
	[ -z "$BOOTING" ] || return 0
	for service in $(tar -tf "$dir/packages.tar" | sed -n 's|^etc/rc\.d/S[0-9][0-9]||p'); do
		"/etc/init.d/$service" start
	done
	return 0
}

case $verb in
keep | undo) "$verb" ;;
do) do_it ;;
*) exit 1 ;;
esac
