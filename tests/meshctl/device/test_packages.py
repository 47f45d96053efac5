"""Laws of packages under the dead-man's switch: without a confirmation the node has exactly those that it had."""

from __future__ import annotations

import pytest

from meshctl.device.deadman import Change, packages
from tests.meshctl.device.changes import BUNDLE, NONCE, OWNER, is_after, is_before, prepare
from tests.meshctl.device.changes import change as files
from tests.meshctl.device.sandbox import Sandbox
from tests.meshctl.device.servers import eventually
from tests.meshctl.device.test_deadman import LONG, applied, armed, last, refusal, staged, state

STATUS = "/usr/lib/opkg/status"
INSTALLED = "/lib/apk/db/installed"
# Packages are names in the tool's own database and a program each. /harness/fail lets an installation fail after its
# first package, /harness/hang lets it never end.
OPKG = r"""#!/bin/sh
db=/usr/lib/opkg/status
verb=$1
shift
case $verb in
install)
	for file; do
		[ -f "$file" ] || exit 255
		name=${file##*/}
		name=${name%%_*}
		printf 'Package: %s\nStatus: install user installed\n\n' "$name" >>$db
		echo "$name" >"/usr/bin/$name"
		[ ! -e /harness/fail ] || exit 255
		[ ! -e /harness/hang ] || { : >/harness/hangs && sleep 100000; }
	done
	;;
remove)
	for name; do
		case $name in -*) continue ;; esac
		[ ! -e /harness/stuck ] || exit 255
		awk -v name="$name" 'BEGIN { RS = ""; ORS = "\n\n" } $2 != name' $db >$db.new
		mv $db.new $db
		rm -f "/usr/bin/$name"
		# as its prerm does
		[ "$name" != wpad-basic ] || { /etc/init.d/wpad stop && rm -f /etc/init.d/wpad /etc/rc.d/S19wpad; }
	done
	;;
files)
	[ "$1" != wpad-basic ] || echo /etc/init.d/wpad
	printf 'Package %s (1) is installed on root and has the following files:\n/usr/bin/%s\n' "$1" "$1"
	;;
esac
"""
WPAD = "#!/bin/sh\necho $1 >>/harness/wpad\n"
APK = r"""#!/bin/sh
db=/lib/apk/db/installed
verb=$1
shift
case $verb in
add)
	for file; do
		case $file in -*) continue ;; esac
		[ -f "$file" ] || exit 1
		name=${file##*/}
		name=${name%%-[0-9]*}
		printf 'P:%s\nV:1\n\n' "$name" >>$db
		echo "$name" >"/usr/bin/$name"
	done
	;;
del)
	for name; do
		case $name in -*) continue ;; esac
		awk -v name="P:$name" 'BEGIN { RS = ""; ORS = "\n\n" } $1 != name' $db >$db.new
		mv $db.new $db
		rm -f "/usr/bin/$name"
	done
	;;
info) printf '%s-1 contains:\nusr/bin/%s\n' "$2" "$2" ;;
esac
"""
FILES = ("/tmp/meshctl/packages/batman_1_mips.ipk", "/tmp/meshctl/packages/wpad-full_1_mips.ipk")
BEFORE = {"base-files", "wpad-basic"}


def with_opkg(node: Sandbox) -> None:
    node.put("/usr/bin/opkg", OPKG, 0o755)
    node.put(STATUS, "".join(f"Package: {name}\nStatus: install ok installed\n\n" for name in sorted(BEFORE)))
    node.put("/usr/bin/wpad-basic", "the old one\n", 0o755)
    node.put("/etc/init.d/wpad", WPAD, 0o755)
    node.path("/etc/rc.d").mkdir(parents=True, exist_ok=True)
    node.path("/etc/rc.d/S19wpad").symlink_to("../init.d/wpad")
    for file in FILES:
        node.put(file, "")


def change(*, touches_files: bool = False) -> Change:
    script = packages("opkg", FILES, ["wpad-basic"])
    if not touches_files:
        return Change("c1", {}, "exit 0\n", extra=script)
    other = files()
    return Change("c1", other.files, other.reload, other.links, other.removed, expected=other.expected, extra=script)


def there(node: Sandbox) -> set[str]:
    return {line.split()[1] for line in (node.text(STATUS) or "").splitlines() if line.startswith("Package:")}


def is_as_before(node: Sandbox) -> bool:
    return (
        there(node) == BEFORE
        and node.text("/usr/bin/wpad-basic") == "the old one\n"
        and not node.path("/usr/bin/batman").exists()
        and not node.path("/usr/bin/wpad-full").exists()
    )


def test_confirmed_packages_stay_and_their_files_leave_the_memory(node: Sandbox) -> None:
    with_opkg(node)
    applied(node, wanted=change())
    assert there(node) == {"base-files", "batman", "wpad-full"}
    assert node.deadman("confirm", "c1", NONCE).startswith("ok")
    node.close_processes()
    node.reboot()
    node.deadman("boot")
    assert there(node) == {"base-files", "batman", "wpad-full"}
    assert not node.path("/etc/meshctl/change").exists()


def test_unconfirmed_packages_are_removed_and_those_removed_put_back(node: Sandbox) -> None:
    with_opkg(node)
    applied(node, window_s="1", wanted=change())
    eventually(lambda: state(node) == "idle" and not node.processes())
    assert is_as_before(node)
    assert last(node) == ("c1", "restored", "timeout")


def test_what_a_package_runs_is_started_again_when_it_is_put_back(node: Sandbox) -> None:
    with_opkg(node)
    applied(node, window_s="1", wanted=change())
    assert node.text("/harness/wpad") == "stop\n"
    eventually(lambda: state(node) == "idle" and not node.processes())
    assert node.text("/harness/wpad") == "stop\nstart\n"


def test_files_and_packages_of_one_change_go_and_come_back_together(node: Sandbox) -> None:
    with_opkg(node)
    applied(node, wanted=change(touches_files=True))
    assert is_after(node.path("/etc"))
    node.deadman("abort", OWNER, "c1")
    eventually(lambda: state(node) == "idle" and not node.processes())
    assert is_before(node.path("/etc"))
    assert is_as_before(node)


def test_an_installation_that_fails_half_way_is_undone_before_any_file_changes(node: Sandbox) -> None:
    with_opkg(node)
    node.put("/harness/fail", "")
    armed(node, LONG, change(touches_files=True))
    node.deadman("apply", OWNER, "c1", "now")
    eventually(lambda: state(node) == "idle" and not node.processes())
    assert is_as_before(node)
    assert is_before(node.path("/etc"))
    assert last(node) == ("c1", "restored", "failed")


def test_a_power_cut_in_the_middle_of_an_installation_is_undone_by_the_boot(node: Sandbox) -> None:
    with_opkg(node)
    node.put("/harness/hang", "")
    armed(node, LONG, change())
    node.deadman("apply", OWNER, "c1", "now")
    eventually(lambda: node.path("/harness/hangs").exists())
    node.close_processes()
    assert there(node) == {"base-files", "batman"}
    node.reboot()
    node.deadman("boot")
    assert is_as_before(node)
    assert last(node) == ("c1", "restored", "boot")
    # services that came back with their packages start with the next boot
    assert node.text("/harness/reboots") == "reboot\n"
    assert node.text("/harness/wpad") == "stop\n"


def test_staging_and_dropping_a_change_of_packages_touches_none(node: Sandbox) -> None:
    with_opkg(node)
    staged(node, change())
    node.deadman("abort", OWNER, "c1")
    assert is_as_before(node)


def test_packages_that_cannot_be_removed_do_not_block_the_rollback_and_are_reported(node: Sandbox) -> None:
    with_opkg(node)
    applied(node, wanted=change(touches_files=True))
    node.put("/harness/stuck", "")
    node.deadman("abort", OWNER, "c1")
    eventually(lambda: state(node) == "idle" and not node.processes())
    assert is_before(node.path("/etc"))
    assert last(node) == ("c1", "restored", "abort+packages-stay")


def test_a_node_whose_package_database_cannot_be_read_is_refused(node: Sandbox) -> None:
    with_opkg(node)
    node.path(STATUS).unlink()
    prepare(node, change())
    node.deadman("lock", OWNER, LONG)
    assert refusal(node.deadman("stage", OWNER, "c1", BUNDLE)) == "flash-full"


def test_apk_is_undone_as_well(node: Sandbox) -> None:
    node.put("/usr/bin/apk", APK, 0o755)
    node.put(INSTALLED, "P:base-files\nV:1\n\nP:wpad-basic\nV:1\n\n")
    node.put("/usr/bin/wpad-basic", "the old one\n", 0o755)
    node.put("/tmp/meshctl/packages/wpad-full-1.apk", "")
    script = packages("apk", ["/tmp/meshctl/packages/wpad-full-1.apk"], ["wpad-basic"])
    applied(node, wanted=Change("c1", {}, "exit 0\n", extra=script))
    assert "P:wpad-full" in (node.text(INSTALLED) or "")
    node.deadman("abort", OWNER, "c1")
    eventually(lambda: state(node) == "idle" and not node.processes())
    assert node.text(INSTALLED) == "P:base-files\nV:1\n\nP:wpad-basic\nV:1\n\n"
    assert node.text("/usr/bin/wpad-basic") == "the old one\n"
    assert not node.path("/usr/bin/wpad-full").exists()


def test_words_that_a_shell_would_split_are_refused() -> None:
    with pytest.raises(ValueError, match="without blanks"):
        packages("opkg", ["/tmp/a b.ipk"])
    with pytest.raises(ValueError, match="expected opkg or apk"):
        packages("dpkg", [])
