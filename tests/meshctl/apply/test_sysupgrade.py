"""The archive that a flashed node unpacks at its first boot, and what proves that it was flashed."""

from __future__ import annotations

import io
import tarfile

import pytest

from meshctl.apply.sysupgrade import MARKER_PATH, archive, has_booted, verdict, why_not_flashed
from meshctl.device import deadman
from meshctl.device.observation import BoardInfo, FileInfo, Observation, ReleaseInfo
from meshctl.device.openwrt import FetchedFile, Upgrade
from meshctl.fleet import Result
from tests.meshctl.plan.support import fleet, wanted

KEYS = {"/etc/dropbear/dropbear_ed25519_host_key": FetchedFile(b"private", 0o600)}


def members(data: bytes) -> dict[str, tarfile.TarInfo]:
    with tarfile.open(fileobj=io.BytesIO(data), mode="r:gz") as tar:
        return {member.name: member for member in tar}


def test_the_archive_holds_configuration_host_keys_dead_mans_switch_and_marker() -> None:
    found = members(archive(wanted(fleet(), "b01"), KEYS, "mark"))
    rendered = {file.path for file in wanted(fleet(), "b01").files}
    switch = {path.lstrip("/") for path in deadman.installed_files()}
    assert set(found) == {
        *rendered,
        *switch,
        "etc/dropbear/dropbear_ed25519_host_key",
        MARKER_PATH.lstrip("/"),
        deadman.INIT_LINK.lstrip("/"),
    }


def test_private_files_stay_private_and_the_boot_hook_is_enabled() -> None:
    found = members(archive(wanted(fleet(), "b01"), KEYS, "mark"))
    assert found["etc/dropbear/dropbear_ed25519_host_key"].mode == 0o600
    assert found["etc/config/wireless"].mode == 0o600
    assert found[deadman.INIT_LINK.lstrip("/")].issym()
    assert {member.uid for member in found.values()} == {0}


def test_the_archive_is_deterministic() -> None:
    assert archive(wanted(fleet(), "b01"), KEYS, "mark") == archive(wanted(fleet(), "b01"), KEYS, "mark")


OLD, NEW = "r24106-10cc5fcd00", "r28427-6df0e3d02a"
BEFORE = Observation(0.0, 0.0, boot_id="boot-1")
FLASHED = fleet(firmware=f"firmware: {{image: new.bin, revision: {NEW}}}").nodes["b01"].hardware


def seen(revision: str, boot_id: str | None, marker: str | None) -> Observation:
    file = None if marker is None else FileInfo(MARKER_PATH, 0o644, "", f"{marker}\n")
    return Observation(
        1.0,
        2.0,
        release=ReleaseInfo("OpenWrt", "24.10.7", revision, FLASHED.target),
        board=BoardInfo(FLASHED.board),
        boot_id=boot_id,
        files={MARKER_PATH: file},
    )


@pytest.mark.parametrize("boot_id", ["boot-2", "boot-1", None])
def test_the_marker_and_the_revision_prove_a_flash_whatever_the_boot_id_says(boot_id: str | None) -> None:
    now = seen(NEW, boot_id, "mark")
    assert has_booted(BEFORE, now, "mark")
    assert verdict("b01", FLASHED, now, "mark").result is Result.DONE


@pytest.mark.parametrize("marker", ["mark", "of an earlier flash", None])
def test_a_boot_of_the_previous_firmware_is_no_flash(marker: str | None) -> None:
    """A board with two slots may fall back to the first one, with the archive unpacked."""
    now = seen(OLD, "boot-2", marker)
    assert has_booted(BEFORE, now, "mark")
    outcome = verdict("b01", FLASHED, now, "mark")
    assert outcome.result is Result.FAILED
    assert f"it runs {OLD}, not {NEW}" in outcome.reason


def test_the_new_firmware_with_another_configuration_is_a_failure() -> None:
    outcome = verdict("b01", FLASHED, seen(NEW, "boot-2", None), "mark")
    assert outcome.result is Result.FAILED
    assert "its configuration is not the flashed one" in outcome.reason


@pytest.mark.parametrize(("before", "now"), [("boot-1", "boot-1"), ("boot-1", None), (None, "boot-1"), (None, None)])
def test_a_node_that_has_not_booted_yet_is_waited_for(before: str | None, now: str | None) -> None:
    """It may not report its boot id while sysupgrade ends its processes."""
    assert not has_booted(Observation(0.0, 0.0, boot_id=before), seen(OLD, now, "of an earlier flash"), "mark")


@pytest.mark.parametrize("after_s", [0.0, 121.0, 800.0])
def test_a_slow_node_that_still_upgrades_is_not_given_up(after_s: float) -> None:
    """Minutes pass before it reboots if its processor is slow; another flash, or cutting its power, would ruin it."""
    assert why_not_flashed(Upgrade.RUNNING, "", after_s=after_s) is None


def test_an_upgrade_that_failed_is_reported_with_what_it_said() -> None:
    said = "Command failed: Unknown error"
    assert why_not_flashed(Upgrade.ENDED, said, after_s=3.0) == f"its sysupgrade has failed: {said}"
    # start-stop-daemon answers before it has written the process id
    assert why_not_flashed(Upgrade.NOT_STARTED, "", after_s=3.0) is None
    assert why_not_flashed(Upgrade.NOT_STARTED, "", after_s=121.0) == "no sysupgrade runs on it"
