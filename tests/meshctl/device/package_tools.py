"""Stand-ins for opkg and apk in the sandbox, with what matters for a power cut.

As the real ones (opkg of 24.10.7, apk-tools 3.0.5), they unpack the files of all packages, run the scripts, and write
their database last; before a removal, `prerm` disables and stops the services; opkg truncates its database and then
writes it, apk renames a new one and unpacks each file under a temporary name.

/harness/hang-STEP stops a tool for good at prerm, removed (while it writes the database), unpack, postinst or installed
(while it writes the database); /harness/fail makes it fail after the first package and print what is in it,
/harness/stuck each removal.
"""

from __future__ import annotations

from meshlab.images import apk_package, opkg_package
from tests.meshctl.device.sandbox import Sandbox

DATABASE = {"opkg": "/usr/lib/opkg/status", "apk": "/lib/apk/db/installed"}
_LISTS = {"opkg": "/usr/lib/opkg/info", "apk": "/lib/apk/packages"}
_COMMON = r"""#!/bin/sh
hang() { [ ! -e "/harness/hang-$1" ] || { : >/harness/hangs && sleep 100000; }; }

init_scripts() { sed -n 's|^/etc/init.d/||p' "$lists/$1.list"; }

unpack() { # NAME, a gzipped tar at stdin
	gzip -dc >/harness/data
	tar -tf /harness/data | sed -n 's|^\./||; /^\.PKGINFO$/d; s|^|/|p' >"$lists/$1.list"
	[ $tool = opkg ] || { mkdir -p /lib/modules && : >/lib/modules/.apk.0123; }
	tar -xf /harness/data -C / && rm -f /.PKGINFO /lib/modules/.apk.0123 || exit 1
	[ ! -e /harness/hang-unpack ] || [ $tool = opkg ] || : >/lib/modules/.apk.0123
	hang unpack
}

postinst() { # NAME...
	for name; do
		for service in $(init_scripts "$name"); do
			ln -sf "../init.d/$service" "/etc/rc.d/S19$service"
			"/etc/init.d/$service" start
		done
	done
	hang postinst
}

remove() { # NAME...
	for name; do
		[ ! -e /harness/stuck ] || exit 1
		for service in $(init_scripts "$name"); do
			rm -f "/etc/rc.d/S19$service"
			"/etc/init.d/$service" stop
		done
		hang prerm
		for file in $(cat "$lists/$name.list"); do rm -f "$file"; done
		rm -f "$lists/$name."*
	done
}

write() { # STEP TEXT: the database
	if [ $tool = apk ]; then
		hang "$1"
		printf '%s' "$2" >$db.new && mv $db.new $db
	else
		: >$db
		hang "$1"
		printf '%s' "$2" >$db
	fi
}

without() { # NAME...: the database without them
	awk -v names=" $* " 'BEGIN { RS = ""; ORS = "\n\n" } { name = $1 == "Package:" ? $2 : substr($1, 3) }
		index(names, " " name " ") == 0' $db
}

entries() { # NAME...
	for name; do
		printf "$entry" "$name"
	done
}
# kept by command substitution, which drops newlines at the end
new_line='
'
"""
_OPKG = r"""
entry='Package: %s\nStatus: install user installed\n\n'
tool=opkg db=/usr/lib/opkg/status lists=/usr/lib/opkg/info
verb=$1 names= status=0
shift
case $verb in
install)
	for file; do
		[ -f "$file" ] || exit 255
		name=${file##*/}
		name=${name%%_*}
		tar -xzOf "$file" ./data.tar.gz | unpack "$name"
		echo "control of $name" >"$lists/$name.control"
		names="$names $name"
		[ ! -e /harness/fail ] || { cat /harness/fail >&2 && status=255 && break; }
	done
	[ $status -ne 0 ] || postinst $names
	write installed "$(cat $db; echo; entries $names)$new_line$new_line"
	exit $status
	;;
remove)
	for name; do case $name in -*) ;; *) names="$names $name" ;; esac; done
	rest=$(without $names)
	remove $names
	write removed "$rest$new_line$new_line"
	;;
files)
	echo "Package $1 (1) is installed on root and has the following files:"
	cat "$lists/$1.list"
	;;
esac
"""
_APK = r"""
entry='P:%s\nV:1\n\n'
tool=apk db=/lib/apk/db/installed lists=/lib/apk/packages
verb=$1 names= files=
shift
for word; do case $word in -*) ;; *) files="$files $word" ;; esac; done
case $verb in
add)
	for file in $files; do
		[ -f "$file" ] || exit 1
		name=${file##*/}
		name=${name%-[0-9]*}
		unpack "$name" <"$file"
		names="$names $name"
		[ ! -e /harness/fail ] || { cat /harness/fail >&2 && exit 1; }
	done
	postinst $names
	write installed "$(cat $db; echo; entries $names)$new_line$new_line"
	;;
del)
	rest=$(without $files)
	remove $files
	write removed "$rest$new_line$new_line"
	;;
info)
	echo "$2-1 contains:"
	sed 's|^/||' "$lists/$2.list"
	echo "lib/apk/packages/$2.list"
	;;
# 0 also for a file that it cannot read
manifest)
	if tar -tzf $files >/dev/null 2>&1; then
		tar -tzf $files | sed '/^\.PKGINFO$/d; s|^|sha256:0123  |'
		echo "sha256:0123  lib/apk/packages/$(basename $files | sed 's/-[0-9].*//').list"
	else
		echo "ERROR: $files: file format is invalid or inconsistent" >&2
	fi
	exit 0
	;;
esac
"""


# as in 24.10 and 25.12
_VERSION = "2025.08.26~ca266cc2-r1"


def package(tool: str, name: str, files: dict[str, str]) -> tuple[str, bytes]:
    """A package's file on the node, and its content."""
    if tool == "apk":
        return f"/tmp/meshctl/packages/{name}-{_VERSION}.apk", apk_package(name, _VERSION, files)
    return f"/tmp/meshctl/packages/{name}_{_VERSION}_mips.ipk", opkg_package(name, _VERSION, files)


def install_tool(node: Sandbox, tool: str, installed: dict[str, dict[str, str]]) -> None:
    """Put the stand-in on the node, with these packages (name -> path -> content) installed, their services enabled."""
    node.put(f"/usr/bin/{tool}", _COMMON + (_APK if tool == "apk" else _OPKG), 0o755)
    entry = "P:{}\nV:1\n\n" if tool == "apk" else "Package: {}\nStatus: install user installed\n\n"
    node.put(DATABASE[tool], "".join(entry.format(name) for name in sorted(installed)))
    node.path("/etc/rc.d").mkdir(parents=True, exist_ok=True)
    for name, files in installed.items():
        node.put(f"{_LISTS[tool]}/{name}.list", "".join(f"{path}\n" for path in files))
        for path, content in files.items():
            node.put(path, content, 0o755)
            if path.startswith("/etc/init.d/"):
                link = path.rpartition("/")[2]
                node.path(f"/etc/rc.d/S19{link}").symlink_to(f"../init.d/{link}")


def installed_packages(node: Sandbox, tool: str) -> set[str]:
    """The names in the tool's database."""
    prefix = "P:" if tool == "apk" else "Package: "
    lines = (node.text(DATABASE[tool]) or "").splitlines()
    return {line.removeprefix(prefix) for line in lines if line.startswith(prefix)}
