# Packages of a virtual node: the database of the release's tool (opkg or apk), the files of packages, and the programs of
# some. Sourced after /lab/node/firmware/env. As the real tools do, files are unpacked and services started before the
# database is written.
if [ "$PACKAGE_TOOL" = apk ]; then
	PACKAGE_DB=/lib/apk/db/installed
	PACKAGE_LISTS=/lib/apk/packages
else
	PACKAGE_DB=/usr/lib/opkg/status
	PACKAGE_LISTS=/usr/lib/opkg/info
fi
# entries that package_write appends to the database
PACKAGE_TEXT=

# package_put NAME VERSION: add its entry to PACKAGE_TEXT and install its programs
package_put() {
	if [ "$PACKAGE_TOOL" = apk ]; then
		PACKAGE_TEXT="${PACKAGE_TEXT}P:$1
V:$2
A:$ARCH
S:1024

"
	else
		PACKAGE_TEXT="${PACKAGE_TEXT}Package: $1
Version: $2
Depends: libc
Status: install user installed
Architecture: $ARCH
Installed-Time: 1700000000

"
	fi
	case $1 in
	batctl-*) ln -sf /rom/lab/tools.d/batctl /usr/sbin/batctl ;;
	iw | iw-full) ln -sf /rom/lab/tools.d/iw /usr/sbin/iw ;;
	nftables*) ln -sf /rom/lab/firewall/nft /usr/sbin/nft ;;
	opkg) ln -sf /rom/lab/tools.d/opkg /usr/bin/opkg ;;
	apk-*) ln -sf /rom/lab/tools.d/apk /usr/bin/apk ;;
	esac
}

package_write() {
	mkdir -p "${PACKAGE_DB%/*}"
	printf %s "$PACKAGE_TEXT" >>$PACKAGE_DB
	PACKAGE_TEXT=
}

# package_unpack NAME: unpacks the gzipped tar at stdin and lists its files
package_unpack() {
	mkdir -p $PACKAGE_LISTS
	gzip -dc >/tmp/data.$$ &&
		tar -tf /tmp/data.$$ | sed 's|^\./||; /^\.PKGINFO$/d; /\/$/d; /^$/d; s|^|/|' >"$PACKAGE_LISTS/$1.list" &&
		tar -xf /tmp/data.$$ -C / && rm -f /.PKGINFO /tmp/data.$$
}

# package_files NAME: its files, without the leading slash
package_files() { sed 's|^/||' "$PACKAGE_LISTS/$1.list" 2>/dev/null; }

# package_services VERB VERB NAME: calls the package's init scripts (base-files: default_postinst, default_prerm)
package_services() {
	for service in $(package_files "$3" | sed -n 's|^etc/init.d/||p'); do
		"/etc/init.d/$service" "$1"
		"/etc/init.d/$service" "$2"
	done
}

# package_erase NAME: what its tool does before it drops the entry
package_erase() {
	package_services disable stop "$1"
	for file in $(package_files "$1"); do rm -f "/$file"; done
	rm -f "$PACKAGE_LISTS/$1.list"
}

# package_drop NAME
package_drop() {
	awk -v name="$1" -v field="$([ "$PACKAGE_TOOL" = apk ] && echo P: || echo Package:)" '
		BEGIN { RS = ""; ORS = "\n\n" }
		{ split($0, line, "\n"); first = line[1]; sub(field " *", "", first); if (first != name) print }
	' $PACKAGE_DB >$PACKAGE_DB.new && mv -f $PACKAGE_DB.new $PACKAGE_DB
	case $1 in
	batctl-*) rm -f /usr/sbin/batctl ;;
	iw | iw-full) rm -f /usr/sbin/iw ;;
	esac
}

# package_version NAME: prints it; 1 when the package is not installed
package_version() {
	{ cat $PACKAGE_DB && printf %s "$PACKAGE_TEXT"; } | awk -v name="$1" -v p="$([ "$PACKAGE_TOOL" = apk ] && echo P: || echo Package:)" -v v="$([ "$PACKAGE_TOOL" = apk ] && echo V: || echo Version:)" '
		index($0, p) == 1 { now = substr($0, length(p) + 1); sub(/^ /, "", now) }
		index($0, v) == 1 && now == name { found = substr($0, length(v) + 1); sub(/^ /, "", found); print found }
		END { exit found == "" }
	'
}
