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

# the files that a package file brings; fails if it cannot be read
paths_in() { # FILE: without the leading slash
	case $TOOL in
	apk)
		# exits with 0 in any case
		paths=$(apk manifest --allow-untrusted "$1" | sed 's/^[^ ]*  //')
		[ -n "$paths" ]
		;;
	*) paths=$(tar -xzOf "$1" ./data.tar.gz | tar -tzf -) ;;
	esac && echo "$paths" | sed 's|^\./||; /^$/d; /\/$/d'
}

name_of() { name=${1##*/} && echo "${name%%_*}"; }

# the files that restore a removed package: its own, its rc.d links, the package manager's database
to_keep() {
	for package in $REMOVE; do
		files_of "$package" | while read -r file; do
			echo "$file"
			case $file in etc/init.d/*) for link in /etc/rc.d/[SK][0-9][0-9]"${file##*/}"; do echo "${link#/}"; done ;; esac
		done
	done
	for package in $REMOVE $(for file in $FILES; do name_of "$file"; done); do
		for file in "/usr/lib/opkg/info/$package".*; do echo "${file#/}"; done
	done
	printf '%s\n' usr/lib/opkg/status lib/apk/db/installed lib/apk/db/scripts.tar lib/apk/db/scripts.tar.gz \
		lib/apk/db/triggers etc/apk/world
}

# keep: packages.before (names), packages.new (files that the packages add), packages.tar (files that they replace, and
# `to_keep`). Both tools write their database last, so after a power cut it names neither the packages whose files are
# already there nor those whose files and rc.d links are already gone.
keep() {
	installed >"$dir/packages.before" && [ -s "$dir/packages.before" ] || return 1
	cd / || return 1
	new=$(for file in $FILES; do paths_in "$file" || exit 1; done) || return 1
	for file in $new; do
		exists "$file" || echo "$file"
	done >"$dir/packages.new"
	set --
	for file in $({ to_keep && echo "$new"; } | sort -u); do
		! exists "$file" || set -- "$@" "$file"
	done
	tar -cf "$dir/packages.tar" "$@" && tar -tf "$dir/packages.tar" >/dev/null
}

exists() { [ -f "$1" ] || [ -L "$1" ]; }

do_it() {
	# not empty if packages are removed
	printf %s "$REMOVE" >"$dir/packages.begun" && /bin/sync || return 1
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
	[ -f "$dir/packages.begun" ] || return 0
	# for opkg's lock: at boot this runs before the script that creates the directory
	mkdir -p /var/lock
	new=$(added | tr '\n' ' ')
	# shellcheck disable=SC2086
	case $TOOL$new in
	apk?*) apk del --no-network $new ;;
	opkg?*) opkg remove --force-depends $new ;;
	esac
	cd / && remove_new && tar -xf "$dir/packages.tar" && start_again
}

# Removes what the tool left: after a power cut it does not know the packages that it was installing.
remove_new() {
	for package in $FILES; do
		[ "$TOOL" = apk ] || rm -f "usr/lib/opkg/info/$(name_of "$package")".*
	done
	while read -r file; do
		case $file in
		etc/init.d/*)
			[ -n "$BOOTING" ] || [ ! -x "$file" ] || "/$file" stop
			rm -f etc/rc.d/[SK][0-9][0-9]"${file##*/}"
			;;
		esac
		# apk unpacks to these names first
		rm -f "$file" "${file%/*}"/.apk.*
	done <"$dir/packages.new"
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
