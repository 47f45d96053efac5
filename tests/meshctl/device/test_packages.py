"""Laws of packages under the dead-man's switch: without a confirmation the node has exactly those that it had."""

from __future__ import annotations

import pytest

from meshctl.device.deadman import Change, packages
from tests.meshctl.device.changes import BUNDLE, NONCE, OWNER, is_after, is_before, prepare, refusal
from tests.meshctl.device.changes import change as files
from tests.meshctl.device.package_tools import DATABASE, install_tool, installed_packages, package
from tests.meshctl.device.sandbox import Sandbox
from tests.meshctl.device.servers import eventually
from tests.meshctl.device.test_deadman import LONG, applied, armed, last, staged, state

TOOLS = ("opkg", "apk")
WPAD = "#!/bin/sh\necho $1 >>/harness/wpad\n"
OLD = {
    "base-files": {"/etc/banner": "hello"},
    "wpad-basic": {"/etc/init.d/wpad": WPAD, "/usr/sbin/wpad": "the old one\n"},
}
NEW = {
    "batman": {
        "/etc/init.d/batman": "#!/bin/sh\necho $1 >>/harness/batman\n",
        "/etc/modules.d/batman-adv": "batman-adv\n",
        "/lib/modules/batman-adv.ko": "code\n",
        # there already, of no package: see with_tool
        "/etc/batman.conf": "by the package\n",
    },
    "wpad-full": {"/etc/init.d/wpad": WPAD, "/usr/sbin/wpad": "the new one\n", "/usr/sbin/wpa-extra": "more\n"},
}


@pytest.fixture(params=TOOLS)
def tool(request: pytest.FixtureRequest) -> str:
    assert isinstance(request.param, str)
    return request.param


def with_tool(node: Sandbox, tool: str) -> None:
    install_tool(node, tool, OLD)
    node.put("/etc/batman.conf", "by hand\n")
    for name, contents in NEW.items():
        path, content = package(tool, name, contents)
        node.put(path, content)


def package_files(tool: str) -> list[str]:
    return [package(tool, name, contents)[0] for name, contents in NEW.items()]


def change(tool: str, *, touches_files: bool = False) -> Change:
    script = packages(tool, package_files(tool), ["wpad-basic"])
    if not touches_files:
        return Change("c1", {}, "exit 0\n", extra=script)
    other = files()
    return Change("c1", other.files, other.reload, other.links, other.removed, expected=other.expected, extra=script)


def root(node: Sandbox) -> dict[str, str]:
    """Everything in flash but the switch's own state: path -> content or link."""
    found = {}
    for top in ("/etc", "/lib", "/usr"):
        for path in sorted(node.path(top).rglob("*")):
            name = "/" + str(path.relative_to(node.path("/")))
            if name.startswith("/etc/meshctl/"):
                continue
            if path.is_symlink():
                found[name] = f"-> {path.readlink()}"
            elif path.is_file():
                found[name] = path.read_text(errors="replace")
    return found


def is_after_packages(node: Sandbox, tool: str) -> bool:
    return (
        installed_packages(node, tool) == {"base-files", *NEW}
        and node.text("/usr/sbin/wpad") == "the new one\n"
        and node.path("/etc/rc.d/S19batman").is_symlink()
    )


def start(node: Sandbox) -> None:
    assert node.deadman("apply", OWNER, "c1", "now").startswith("ok")
    eventually(lambda: state(node) in {"applied", "idle"})


def cut_power_at(node: Sandbox, step: str, verb: str, *words: str) -> None:
    """Call the switch, and cut the power when the tool has come to this step."""
    node.put(f"/harness/hang-{step}", "")
    node.deadman(verb, OWNER, "c1", *words)
    eventually(lambda: node.path("/harness/hangs").exists())
    node.close_processes()
    node.path(f"/harness/hang-{step}").unlink()
    node.path("/harness/hangs").unlink()
    node.reboot()


def test_confirmed_packages_persist_and_their_package_files_are_deleted(node: Sandbox, tool: str) -> None:
    with_tool(node, tool)
    applied(node, wanted=change(tool))
    assert is_after_packages(node, tool)
    assert not any(node.path(file).exists() for file in package_files(tool))
    assert node.deadman("confirm", "c1", NONCE).startswith("ok")
    node.close_processes()
    node.reboot()
    node.deadman("boot")
    assert is_after_packages(node, tool)
    assert not node.path("/etc/meshctl/change").exists()


def test_unconfirmed_package_changes_are_fully_rolled_back(node: Sandbox, tool: str) -> None:
    with_tool(node, tool)
    armed(node, "1", change(tool))
    before = root(node)
    start(node)
    eventually(lambda: state(node) == "idle" and not node.processes())
    assert root(node) == before
    assert last(node) == ("c1", "restored", "timeout")


def test_a_packages_services_are_restarted_when_it_is_restored(node: Sandbox, tool: str) -> None:
    with_tool(node, tool)
    applied(node, window_s="1", wanted=change(tool))
    assert node.text("/harness/wpad") == "stop\nstart\n"
    eventually(lambda: state(node) == "idle" and not node.processes())
    assert (node.text("/harness/wpad") or "").split() == ["stop", "start", "stop", "start"]
    assert node.text("/harness/batman") == "start\nstop\n"


def test_files_and_packages_of_a_change_are_applied_and_rolled_back_together(node: Sandbox, tool: str) -> None:
    with_tool(node, tool)
    before = installed_packages(node, tool)
    applied(node, wanted=change(tool, touches_files=True))
    assert is_after(node.path("/etc"))
    node.deadman("abort", OWNER, "c1")
    eventually(lambda: state(node) == "idle" and not node.processes())
    assert is_before(node.path("/etc"))
    assert installed_packages(node, tool) == before


def test_a_failed_package_installation_is_rolled_back_before_any_file_changes(node: Sandbox, tool: str) -> None:
    with_tool(node, tool)
    node.put("/harness/fail", "")
    armed(node, LONG, change(tool, touches_files=True))
    before = root(node)
    node.deadman("apply", OWNER, "c1", "now")
    eventually(lambda: state(node) == "idle" and not node.processes())
    assert root(node) == before
    assert is_before(node.path("/etc"))
    assert last(node) == ("c1", "restored", "failed")


# apk-tools 3.0.5 on a full tmpfs of 5 MiB; opkg of 24.10.7, whose check of the space comes first (opkg_install.c)
NO_ROOM = {
    "apk": "ERROR: batman-1.0-r1: failed to extract usr/lib/batman/blob: No space left on device\n",
    "opkg": " * verify_pkg_installable: Only have 12kb available on filesystem /overlay, pkg batman needs 300\n",
}


def test_a_flash_without_room_for_the_packages_is_named(node: Sandbox, tool: str) -> None:
    with_tool(node, tool)
    node.put("/harness/fail", NO_ROOM[tool])
    armed(node, LONG, change(tool))
    before = root(node)
    node.deadman("apply", OWNER, "c1", "now")
    eventually(lambda: state(node) == "idle" and not node.processes())
    assert root(node) == before
    assert last(node) == ("c1", "restored", "flash-full")


@pytest.mark.parametrize("step", ["prerm", "removed", "unpack", "postinst", "installed"])
def test_a_power_cut_during_package_changes_is_rolled_back_at_boot(node: Sandbox, tool: str, step: str) -> None:
    with_tool(node, tool)
    armed(node, LONG, change(tool))
    before = root(node)
    cut_power_at(node, step, "apply", "now")
    assert root(node) != before
    node.deadman("boot")
    assert root(node) == before
    assert last(node) == ("c1", "restored", "boot")
    # services that came back with their packages start with the next boot
    assert node.text("/harness/reboots") == "reboot\n"
    assert (node.text("/harness/wpad") or "").split().count("start") == (step in ("postinst", "installed"))


def test_a_package_rollback_interrupted_by_a_power_cut_is_completed_at_boot(node: Sandbox, tool: str) -> None:
    with_tool(node, tool)
    armed(node, LONG, change(tool))
    before = root(node)
    start(node)
    cut_power_at(node, "prerm", "abort")
    node.deadman("boot")
    assert root(node) == before


def test_staging_and_aborting_a_package_change_touches_no_packages(node: Sandbox, tool: str) -> None:
    with_tool(node, tool)
    staged(node, change(tool))
    before = root(node)
    node.deadman("abort", OWNER, "c1")
    assert root(node) == before


def test_packages_the_package_manager_cannot_remove_are_removed_without_it(node: Sandbox, tool: str) -> None:
    with_tool(node, tool)
    armed(node, LONG, change(tool, touches_files=True))
    before = root(node)
    start(node)
    node.put("/harness/stuck", "")
    node.deadman("abort", OWNER, "c1")
    eventually(lambda: state(node) == "idle" and not node.processes())
    assert root(node) == before
    assert node.text("/harness/batman") == "start\nstop\n"
    assert last(node) == ("c1", "restored", "abort")


def test_packages_that_cannot_be_restored_do_not_block_the_rollback_and_are_reported(node: Sandbox, tool: str) -> None:
    with_tool(node, tool)
    applied(node, wanted=change(tool, touches_files=True))
    node.put("/etc/meshctl/change/packages.tar", "torn")
    node.deadman("abort", OWNER, "c1")
    eventually(lambda: state(node) == "idle" and not node.processes())
    assert is_before(node.path("/etc"))
    assert last(node) == ("c1", "restored", "abort+packages-stay")


def test_a_node_whose_package_database_cannot_be_read_is_refused(node: Sandbox, tool: str) -> None:
    with_tool(node, tool)
    node.path(DATABASE[tool]).unlink()
    prepare(node, change(tool))
    node.deadman("lock", OWNER, LONG)
    assert refusal(node.deadman("stage", OWNER, "c1", BUNDLE)) == "flash-full"


def test_a_package_file_that_cannot_be_read_is_refused(node: Sandbox, tool: str) -> None:
    with_tool(node, tool)
    node.put(package_files(tool)[0], "torn")
    prepare(node, change(tool))
    node.deadman("lock", OWNER, LONG)
    assert refusal(node.deadman("stage", OWNER, "c1", BUNDLE)) == "flash-full"


def test_paths_with_blanks_and_unknown_package_managers_are_rejected() -> None:
    for name in ("/tmp/a b.ipk", "/tmp/it's.ipk", "/tmp/$(reboot).ipk", "~/a.ipk", ""):
        with pytest.raises(ValueError, match="without blanks"):
            packages("opkg", [name])
    with pytest.raises(ValueError, match="expected opkg or apk"):
        packages("dpkg", [])
