"""The archive that a flashed node unpacks at its first boot, and what proves that it was flashed."""

from __future__ import annotations

import io
import tarfile
import time
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from meshctl.apply import sysupgrade
from meshctl.apply.context import NodeContext
from meshctl.apply.sysupgrade import MARKER_PATH, archive, has_booted, verdict, why_not_flashed
from meshctl.device import deadman
from meshctl.device.observation import BoardInfo, FileInfo, Observation, ReleaseInfo
from meshctl.device.openwrt import FetchedFile, FirmwareCheck, Upgrade
from meshctl.device.ssh import SshConnection
from meshctl.errors import NodeError, Unreachable
from meshctl.fleet import Outcome, Result
from meshctl.nodes.backoff import Backoff
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


def ignore(*_: object, **__: object) -> None:
    """An event that no one listens to."""


LISTENER = cast(Any, SimpleNamespace(armed=ignore, started=ignore, unreachable=ignore, ended=ignore))


class SlowNode:
    """A node that answers with its previous firmware until `leaves_s`, then not, and with the new one from `back_s`."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *, leaves_s: float, back_s: float, timeout_s: int) -> None:
        self.now_s, self.leaves_s, self.back_s = 0.0, leaves_s, back_s
        monkeypatch.setattr(time, "monotonic", lambda: self.now_s)
        monkeypatch.setattr(
            sysupgrade, "Backoff", lambda limit_s, interrupt: Backoff(limit_s, interrupt, _began=self.now_s)
        )
        monkeypatch.setattr(sysupgrade, "observe", lambda _connection, **_: self.observed())
        monkeypatch.setattr("meshctl.device.openwrt.upgrade_state", lambda _connection: (Upgrade.RUNNING, ""))
        keys = (
            f"firmware: {{image: new.bin, revision: {NEW}}}",
            f"flash_timeout_s: {timeout_s}",
            "recovery: press reset",
        )
        self.node = fleet(firmware="\n    ".join(keys)).nodes["b01"]

    def observed(self) -> Observation:
        return seen(NEW, "boot-2", "mark") if self.now_s >= self.back_s else seen(OLD, "boot-1", None)

    def open(self, _node: object) -> object:
        if self.leaves_s <= self.now_s < self.back_s:
            raise NodeError("b01: cannot connect: timed out")
        return SimpleNamespace(close=lambda: None)

    def wait(self, for_s: float) -> None:
        self.now_s += for_s

    @property
    def ctx(self) -> NodeContext:
        run = SimpleNamespace(
            interrupt=SimpleNamespace(leaving=False, wait=self.wait),
            connections=self,
            record=lambda *_: None,
            new_listener=lambda *_: LISTENER,
        )
        step = nullcontext
        return cast(NodeContext, SimpleNamespace(name="b01", node=self.node, before=BEFORE, run=run, step=step))

    def outcome(self) -> Outcome:
        return sysupgrade._await_return(self.ctx, "mark", LISTENER)


def test_the_time_of_a_flash_counts_from_when_the_node_was_last_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a slow processor minutes pass before anything is written."""
    assert SlowNode(monkeypatch, leaves_s=290, back_s=580, timeout_s=300).outcome().result is Result.DONE


@pytest.mark.parametrize(("leaves_s", "result"), [(20, Result.DONE), (1e9, Result.FAILED)])
def test_a_node_shows_whether_it_is_flashed_if_the_link_broke_as_that_was_to_start(
    monkeypatch: pytest.MonkeyPatch, leaves_s: float, result: Result
) -> None:
    """It was reported as unreachable, without a change, while its flash was written."""
    node = SlowNode(monkeypatch, leaves_s=leaves_s, back_s=leaves_s + 100, timeout_s=300)

    def cut(*_: object) -> None:
        raise Unreachable("b01: the connection broke")

    monkeypatch.setattr("meshctl.device.openwrt.start_sysupgrade", cut)
    monkeypatch.setattr("meshctl.device.openwrt.upgrade_state", lambda _connection: (Upgrade.NOT_STARTED, ""))
    monkeypatch.setattr(sysupgrade, "_upload", lambda *_: "mark")
    closed: list[bool] = []
    connection = cast(SshConnection, SimpleNamespace(close=lambda: closed.append(True)))
    outcome = sysupgrade.flash(node.ctx, connection, Path("new.bin"))
    assert (outcome.result, closed) == (result, [True])
    assert outcome.reason == (
        "" if result is Result.DONE else "no sysupgrade runs on it; it runs the previous firmware"
    )


@pytest.mark.parametrize(
    ("check", "why"),
    [
        (FirmwareCheck(False, "Image check failed", {}, None), "its sysupgrade rejects the image: Image check failed"),
        (FirmwareCheck(True, "", {}, 1 << 20), "1 MiB of memory left beside the image, 4 needed"),
    ],
)
def test_an_image_that_is_not_flashed_does_not_stay_in_memory(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, check: FirmwareCheck, why: str
) -> None:
    """Seen on real OpenWrt: it stayed until the next reboot."""
    image = tmp_path / "new.bin"
    image.write_bytes(b"image")
    monkeypatch.setattr(sysupgrade, "install_switch", ignore)
    monkeypatch.setattr(sysupgrade, "upload", ignore)
    monkeypatch.setattr("meshctl.device.deadman.lock", ignore)
    monkeypatch.setattr("meshctl.device.openwrt.check_firmware", lambda *_: check)
    node = SlowNode(monkeypatch, leaves_s=1e9, back_s=1e9, timeout_s=300)
    run = SimpleNamespace(owner="alice", rate_bytes_per_s=None)
    ctx = SimpleNamespace(name="b01", node=node.node, before=BEFORE, run=run, step=nullcontext, progress=None)
    commands: list[str] = []
    connection = cast(SshConnection, SimpleNamespace(run=commands.append))
    with pytest.raises(NodeError, match=why):
        sysupgrade._upload(cast(NodeContext, ctx), connection, image)
    assert commands == ["rm -f /tmp/meshctl/firmware.bin"]


def test_a_slower_flash_is_waited_for_if_the_inventory_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    assert SlowNode(monkeypatch, leaves_s=20, back_s=3000, timeout_s=900).outcome().result is Result.UNCERTAIN
    assert SlowNode(monkeypatch, leaves_s=20, back_s=3000, timeout_s=3600).outcome().result is Result.DONE


def test_a_flash_that_is_late_may_still_be_written(monkeypatch: pytest.MonkeyPatch) -> None:
    node = SlowNode(monkeypatch, leaves_s=20, back_s=3000, timeout_s=300)
    late = node.outcome()
    assert late.result is Result.UNCERTAIN
    # it is looked at every two seconds
    assert 318 <= node.now_s <= 320
    assert "within flash_timeout_s, 300 s after it was last seen" in late.reason
    assert "leave it on" in late.hint
    assert late.hint.endswith("press reset")


def test_an_upgrade_that_never_ends_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    node = SlowNode(monkeypatch, leaves_s=1e9, back_s=1e9, timeout_s=300)
    late = node.outcome()
    assert late.result is Result.UNCERTAIN
    assert 598 <= node.now_s <= 600
    assert late.reason == "its sysupgrade has not ended within flash_timeout_s, 300 s"
