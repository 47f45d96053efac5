"""The Python verbs over a real dropbear and ash; OpenWrt's own tools are stand-ins that note how they were called."""

from __future__ import annotations

import random
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from meshctl.device import deadman, openwrt
from meshctl.device.connection import Connection
from meshctl.device.deadman import Change, NewFile
from meshctl.device.errors import CommandFailed, NodeRefused
from meshctl.device.observe import observe
from meshctl.device.ssh import SshConnection
from meshctl.errors import Unreachable
from meshctl.model import Secret
from tests.meshctl.device.changes import change, is_after, is_before, prepare
from tests.meshctl.device.sandbox import Sandbox
from tests.meshctl.device.servers import Server, eventually, log_in

OWNER = "alice@laptop:run-7"
NONCE = Secret("0f1e2d3c4b5a69788796a5b4c3d2e1f0")

NOTING = """#!/bin/sh
echo "${0##*/} $*" >>/harness/calls
"""
SYSUPGRADE = (
    NOTING
    + """
case $1 in
-b) echo backup >"$2" ;;
-T) if [ "$2" = -n ] && grep -q good "$3"; then exit 0; else
	echo "Sun Nov 22 03:21:04 UTC 2026 upgrade: Device x not supported by this image" >&2
	echo "Sun Nov 22 03:21:04 UTC 2026 upgrade: Use sysupgrade -F to override this check" >&2
	echo "Image check failed." >&2; exit 1; fi ;;
esac
"""
)
UBUS = (
    NOTING
    + """
[ "$3" = validate_firmware_image ] || exit 4
echo '{'
echo '	"tests": { "fwtool_signature": true, "fwtool_device_match": true },'
echo '	"valid": true, "forceable": true, "allow_backup": true'
echo '}'
"""
)


def calls(node: Sandbox) -> list[str]:
    return (node.text("/harness/calls") or "").splitlines()


def test_a_change_from_installation_to_confirmation(
    connection: SshConnection, server: Server, node: Sandbox, tmp_path: Path
) -> None:
    for path in (deadman.PROGRAM, deadman.INIT_SCRIPT, deadman.INIT_LINK):
        node.path(path).unlink()
    assert not deadman.status(connection).installed
    deadman.install(connection)
    assert deadman.status(connection).state == "idle"
    prepare(node)
    deadman.lock(connection, OWNER, ttl_s=1000)
    deadman.stage(connection, OWNER, change())
    assert not node.path("/tmp/meshctl/c1.tgz").exists()
    assert is_before(node.path("/etc"))
    deadman.arm(connection, OWNER, "c1", nonce=NONCE, window_s=10000)
    due = deadman.apply(connection, OWNER, "c1", in_s=0.1)
    assert due > 0
    connection.close()
    with log_in(server, node, tmp_path) as again:
        eventually(lambda: deadman.status(again).state == "applied")
        seen = observe(again).change
        assert seen is not None
        assert (seen.state, seen.change_id, seen.owner, seen.window_s) == ("applied", "c1", OWNER, 10000)
        with pytest.raises(NodeRefused) as caught:
            deadman.confirm(again, "c1", nonce=Secret("another"))
        assert caught.value.code == "wrong-nonce"
        deadman.confirm(again, "c1", nonce=NONCE)
        deadman.confirm(again, "c1", nonce=NONCE)
        deadman.unlock(again, OWNER)
        status = deadman.status(again)
    assert (status.last_id, status.last_outcome, status.lock_owner) == ("c1", "confirmed", "")
    assert is_after(node.path("/etc"))


def test_an_applied_change_outlives_its_connection_and_rolls_back_on_timeout(
    connection: SshConnection, server: Server, node: Sandbox, tmp_path: Path
) -> None:
    prepare(node)
    deadman.lock(connection, OWNER, ttl_s=1000)
    deadman.stage(connection, OWNER, change())
    deadman.arm(connection, OWNER, "c1", nonce=NONCE, window_s=1)
    deadman.apply(connection, OWNER, "c1")
    connection.close()
    with log_in(server, node, tmp_path) as again:
        eventually(lambda: deadman.status(again).last_reason == "timeout")
        assert deadman.status(again).last_outcome == "restored"
    assert is_before(node.path("/etc"))


def test_a_look_is_answered_when_the_reload_has_ended(
    connection: SshConnection, server: Server, node: Sandbox, tmp_path: Path
) -> None:
    """Otherwise a slow node gets a login every few seconds while its services reload."""
    reloads = change(reload="until [ -e /harness/go ]; do sleep 1; done; exit 7")
    prepare(node, reloads)
    # of no change in progress, or before it starts: answered at once
    assert deadman.status(connection, started="c1", await_reload_s=600).state == "idle"
    deadman.lock(connection, OWNER, ttl_s=1000)
    deadman.stage(connection, OWNER, reloads)
    deadman.arm(connection, OWNER, "c1", nonce=NONCE, window_s=10000)
    assert deadman.status(connection, started="c1", await_reload_s=600).state == "armed"
    deadman.apply(connection, OWNER, "c1")
    with log_in(server, node, tmp_path) as other, ThreadPoolExecutor(1) as pool:
        short = deadman.status(connection, started="c1", await_reload_s=1)
        look = pool.submit(deadman.status, connection, started="c1", await_reload_s=50)
        eventually(lambda: deadman.status(other).state == "applied")
        node.put("/harness/go", "")
        seen = look.result()
    assert (short.state in ("waiting", "applied"), short.reload_status) == (True, None)
    assert (seen.state, seen.reload_status) == ("applied", 7)


def test_a_refusal_carries_its_code_and_its_reason(connection: SshConnection, node: Sandbox) -> None:
    prepare(node)
    with pytest.raises(NodeRefused, match="take the lock first") as caught:
        deadman.stage(connection, OWNER, change())
    assert caught.value.code == "not-locked"
    assert "run again" in caught.value.hint
    deadman.lock(connection, OWNER, ttl_s=1000)
    with pytest.raises(NodeRefused, match=f"held by {OWNER}") as caught:
        deadman.lock(connection, "bob@base", ttl_s=1000)
    assert caught.value.code == "locked"
    deadman.stage(connection, OWNER, change())
    deadman.abort(connection, OWNER, "c1")
    assert deadman.status(connection).last_outcome == "aborted"


def test_a_missing_or_broken_dead_mans_switch_is_reported(connection: SshConnection, node: Sandbox) -> None:
    node.put(deadman.PROGRAM, "#!/bin/sh\necho what\n", 0o755)
    with pytest.raises(CommandFailed, match="answered lock with 'what'"):
        deadman.lock(connection, OWNER, ttl_s=1)
    with pytest.raises(CommandFailed, match="answered status"):
        deadman.status(connection)
    node.path(deadman.PROGRAM).unlink()
    with pytest.raises(CommandFailed, match="not found"):
        deadman.lock(connection, OWNER, ttl_s=1)
    with pytest.raises(ValueError, match="expected letters"):
        deadman.lock(connection, "two words", ttl_s=1)
    with pytest.raises(ValueError, match="not both"):
        deadman.apply(connection, OWNER, "c1", in_s=1, at_uptime_s=1)


def test_a_bundle_whose_sender_dies_does_not_stay_in_memory(
    connection: SshConnection, node: Sandbox, monkeypatch: pytest.MonkeyPatch
) -> None:
    closed = threading.Event()

    def half(data: bytes, rate_bytes_per_s: float) -> Iterator[bytes]:
        yield data[: len(data) // 2]
        closed.wait()

    monkeypatch.setattr(deadman, "paced", half)
    prepare(node)
    deadman.lock(connection, OWNER, ttl_s=1000)
    with ThreadPoolExecutor(1) as sender:
        sent = sender.submit(deadman.stage, connection, OWNER, change(), rate_bytes_per_s=1000.0)
        uploads = node.path("/tmp/meshctl")
        eventually(lambda: any(file.stat().st_size for file in uploads.glob("*c1.tgz*")))
        connection.close()
        closed.set()
        with pytest.raises(Unreachable):
            sent.result()
    eventually(lambda: not list(uploads.glob("*c1.tgz*")))
    assert not node.path("/etc/meshctl/change").exists()


def test_a_bundle_without_room_in_memory_is_refused(connection: SshConnection, node: Sandbox) -> None:
    deadman.lock(connection, OWNER, ttl_s=1000)
    node.path("/tmp/meshctl/c1.tgz").mkdir()
    with pytest.raises(NodeRefused, match="no room in /tmp/meshctl for the bundle") as caught:
        deadman.stage(connection, OWNER, change())
    assert (caught.value.code, "du -ak /tmp" in caught.value.hint) == ("tmp-full", True)


def test_a_change_of_many_kilobytes_arrives_whole(connection: SshConnection, node: Sandbox) -> None:
    content = random.Random(1).randbytes(2 * deadman.MAX_INLINE_BUNDLE_BYTES)
    deadman.lock(connection, OWNER, ttl_s=1000)
    deadman.stage(connection, OWNER, Change("big", {"/etc/big/file": NewFile(content, 0o600)}, "true"))
    assert node.path("/etc/meshctl/change/new/etc/big/file").read_bytes() == content


def test_uptime_is_measured_against_the_local_clock_with_an_error_bound(
    connection: SshConnection, node: Sandbox
) -> None:
    seen = openwrt.measure_uptime(connection)
    assert seen.boot_id == (node.text("/harness/boot_id") or "").strip()
    assert seen.error_s > 0
    assert seen.uptime_at(seen.at_s + 10) == pytest.approx(seen.uptime_s + 10)


def test_files_come_back_with_their_bytes_and_modes(connection: SshConnection, node: Sandbox) -> None:
    node.put("/etc/dropbear/dropbear_rsa_host_key", bytes(range(256)), 0o600)
    found = openwrt.fetch_files(connection, ["/etc/dropbear/dropbear_*_host_key", "/etc/passwd", "/etc/nowhere"])
    assert set(found) == {
        "/etc/dropbear/dropbear_ed25519_host_key",
        "/etc/dropbear/dropbear_rsa_host_key",
        "/etc/passwd",
    }
    assert found["/etc/dropbear/dropbear_rsa_host_key"].content == bytes(range(256))
    assert found["/etc/dropbear/dropbear_rsa_host_key"].mode == 0o600
    assert openwrt.fetch_files(connection, ["/etc/nowhere"]) == {}
    with pytest.raises(ValueError, match="without blanks"):
        openwrt.fetch_files(connection, ["/etc/a b; reboot"])


def test_a_backup_is_created_by_sysupgrade(connection: SshConnection, node: Sandbox) -> None:
    node.put("/sbin/sysupgrade", SYSUPGRADE, 0o755)
    assert openwrt.backup(connection) == b"backup\n"
    assert list(node.path("/tmp/meshctl").glob("backup*")) == []


def test_an_image_is_validated_by_sysupgrade_and_procd(connection: SshConnection, node: Sandbox) -> None:
    node.put("/sbin/sysupgrade", SYSUPGRADE, 0o755)
    node.put("/tmp/good.bin", "good")
    node.put("/tmp/bad.bin", "wrong board")
    bad = openwrt.check_firmware(connection, "/tmp/bad.bin")
    assert (bad.valid, bad.reason) == (False, "Device x not supported by this image; Image check failed")
    assert bad.available_bytes is not None
    without_procd = openwrt.check_firmware(connection, "/tmp/good.bin")
    assert (without_procd.valid, without_procd.tests) == (True, {})
    node.put("/bin/ubus", UBUS, 0o755)
    good = openwrt.check_firmware(connection, "/tmp/good.bin")
    assert (good.valid, good.reason) == (True, "")
    assert good.tests == {"fwtool_signature": True, "fwtool_device_match": True}
    node.put("/bin/ubus", UBUS.replace('"valid": true', '"valid": false'), 0o755)
    assert not openwrt.check_firmware(connection, "/tmp/good.bin").valid
    # procd would refuse to flash it together with our archive
    node.put("/bin/ubus", UBUS.replace('"allow_backup": true', '"allow_backup": false'), 0o755)
    bare = openwrt.check_firmware(connection, "/tmp/good.bin")
    assert (bare.valid, bare.reason) == (False, "it does not accept a configuration from the running system")


def test_starting_sysupgrade_answers_before_the_connection_ends(connection: Connection, node: Sandbox) -> None:
    node.put("/sbin/sysupgrade", SYSUPGRADE, 0o755)
    openwrt.start_sysupgrade(connection, "/tmp/image.bin", "/tmp/config.tgz")
    eventually(lambda: calls(node) == ["sysupgrade -n -f /tmp/config.tgz /tmp/image.bin"])


# as the real one's end: it asks procd, which may answer too late for it
UPGRADING = """#!/bin/sh
echo "Sun Nov 22 03:21:04 UTC 2026 upgrade: Commencing upgrade. Closing all shell sessions."
until [ -e /harness/answered ]; do sleep 1; done
echo "Command failed: $(cat /harness/answered)" >&2
exit 1
"""


def test_an_upgrade_is_over_only_when_procd_answers_again(connection: SshConnection, node: Sandbox) -> None:
    node.put("/sbin/sysupgrade", UPGRADING, 0o755)
    node.put("/bin/ubus", "#!/bin/sh\ncase $* in 'call system board') [ -e /harness/procd ] ;; esac\n", 0o755)
    assert openwrt.upgrade_state(connection) == (openwrt.Upgrade.NOT_STARTED, "")
    openwrt.start_sysupgrade(connection, "/tmp/image.bin", "/tmp/config.tgz")
    said = "Commencing upgrade. Closing all shell sessions."
    eventually(lambda: openwrt.upgrade_state(connection) == (openwrt.Upgrade.RUNNING, said))
    node.put("/harness/answered", "Request timed out")
    said += "; Command failed: Request timed out"
    # its script has ended, and procd continues with the upgrade
    eventually(lambda: openwrt.upgrade_state(connection) == (openwrt.Upgrade.RUNNING, said))
    node.put("/harness/procd", "answers")
    eventually(lambda: openwrt.upgrade_state(connection) == (openwrt.Upgrade.ENDED, said))


def test_a_first_boot_lasts_until_sysupgrades_archive_is_deleted(connection: SshConnection, node: Sandbox) -> None:
    assert not openwrt.is_first_boot(connection)
    node.put("/sysupgrade.tgz", "the configuration that the flash kept")
    assert openwrt.is_first_boot(connection)
    assert observe(connection).is_first_boot
    node.run("/bin/sh", "-c", "rm -f /sysupgrade.tgz")
    assert not openwrt.is_first_boot(connection)
    assert observe(connection).is_first_boot is False
