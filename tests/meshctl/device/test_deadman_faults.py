"""The dead-man's switch, stopped at every single command: by a kill, and by a power cut that also loses unsynced bytes.

After each, the node holds exactly the old state or exactly the new one, never a mixture; it holds the new one only when
the confirmation was on its way; and the same change can then be made.
"""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from meshctl.device.deadman import bundle
from tests.meshctl.device.changes import BUNDLE, NONCE, NONCE_HASH, OWNER, change, is_after, is_before, prepare
from tests.meshctl.device.faults import Faults, Run, fingerprint
from tests.meshctl.device.sandbox import Sandbox
from tests.meshctl.device.servers import eventually

# Far longer than any test runs: where the window is to stay open it stays open.
WINDOW_S = "100000"
BUNDLE_HASH = hashlib.sha256(bundle(change())).hexdigest()


def lock(faults: Faults) -> None:
    assert faults.node.deadman("lock", OWNER, "100000").startswith("ok")


def stage(faults: Faults) -> None:
    prepare(faults.node)
    lock(faults)
    assert faults.run("stage", OWNER, "c1", BUNDLE).answer == "ok state=staged id=c1"


def arm(faults: Faults, window_s: str = WINDOW_S) -> None:
    stage(faults)
    assert faults.run("arm", OWNER, "c1", NONCE_HASH, window_s).answer == "ok state=armed id=c1"


def start(faults: Faults) -> None:
    arm(faults)
    faults.node.path("/tmp/meshctl/change-c1").mkdir(exist_ok=True)


def applied(faults: Faults) -> None:
    """The change is made and the window open; the process that made it was killed as soon as it began to wait."""
    start(faults)
    assert faults.run("watch", "c1", "0", stop_at_sleep=True).killed
    assert is_after(faults.node.path("/etc"))


def expired(faults: Faults) -> None:
    """As `start`, with a window of no length: the next `watch` applies and restores at once."""
    arm(faults, window_s="0")
    faults.node.path("/tmp/meshctl/change-c1").mkdir(exist_ok=True)


def bundled(faults: Faults) -> None:
    prepare(faults.node)


def prepared(faults: Faults) -> None:
    prepare(faults.node)
    lock(faults)


# name -> (what was done before, the verb under fault, may the new state be what survives)
VERBS: dict[str, tuple[Callable[[Faults], None], tuple[str, ...], bool]] = {
    "stage": (prepared, ("stage", OWNER, "c1", BUNDLE), False),
    "arm": (stage, ("arm", OWNER, "c1", NONCE_HASH, WINDOW_S), False),
    "change": (bundled, ("change", OWNER, "100000", "c1", NONCE_HASH, WINDOW_S, "0", BUNDLE_HASH), False),
    "apply": (start, ("watch", "c1", "0"), False),
    "restore": (expired, ("watch", "c1", "0"), False),
    "confirm": (applied, ("confirm", "c1", NONCE), True),
    "abort": (stage, ("abort", OWNER, "c1"), False),
    "restore on boot": (applied, ("boot",), False),
}


def do(faults: Faults, name: str, *, pictures: bool = False, kill_at: int | None = None) -> Run:
    stdin = BUNDLE if name == "change" else ""
    return faults.run(*VERBS[name][1], pictures=pictures, kill_at=kill_at, stop_at_sleep=name == "apply", stdin=stdin)


def make_the_change(faults: Faults, change_id: str) -> None:
    """The whole chain, as an operator who comes back would run it."""
    node = faults.node
    node.put(BUNDLE, bundle(change(change_id)))
    lock(faults)
    assert faults.run("stage", OWNER, change_id, BUNDLE).answer == f"ok state=staged id={change_id}"
    assert faults.run("arm", OWNER, change_id, NONCE_HASH, WINDOW_S).answer == f"ok state=armed id={change_id}"
    node.path(f"/tmp/meshctl/change-{change_id}").mkdir(parents=True, exist_ok=True)
    assert faults.run("watch", change_id, "0", stop_at_sleep=True).killed
    assert faults.run("confirm", change_id, NONCE).answer == f"ok state=idle id={change_id} outcome=confirmed"
    assert is_after(node.path("/etc"))


@pytest.mark.parametrize("name", VERBS)
def test_a_power_cut_at_any_command_leaves_the_old_state_or_the_new(name: str, node: Sandbox, tmp_path: Path) -> None:
    faults = Faults(node)
    before, _, may_be_new = VERBS[name]
    before(faults)
    run = do(faults, name, pictures=True)
    assert len(run.commands) > 3
    answered = run.answer.startswith("ok")
    cuts = list(faults.after_cut(run, tmp_path / "cuts"))
    ended: dict[str, str] = {}
    for label, etc in cuts:
        shutil.rmtree(node.path("/etc"))
        shutil.copytree(etc, node.path("/etc"), symlinks=True)
        node.reboot()
        assert node.run("/usr/sbin/meshctl-deadman", "boot").returncode == 0, label
        old, new = is_before(node.path("/etc")), is_after(node.path("/etc"))
        assert old or (new and may_be_new), label
        if name == "confirm" and label.startswith(f"cut before {len(run.commands) + 1} "):
            assert answered, label
            assert new, "what was answered as confirmed has to last"
        status = node.deadman("status")
        assert " state=idle " in status or " state=staged " in status, label
        settled = fingerprint(node.path("/etc"))
        node.reboot()
        node.run("/usr/sbin/meshctl-deadman", "boot")
        assert fingerprint(node.path("/etc")) == settled, f"{label}: a second boot changed something"
        if old:
            ended.setdefault(settled, label)
    for number, label in enumerate(ended.values()):
        etc = next(etc for found, etc in cuts if found == label)
        shutil.rmtree(node.path("/etc"))
        shutil.copytree(etc, node.path("/etc"), symlinks=True)
        node.reboot()
        node.run("/usr/sbin/meshctl-deadman", "boot")
        make_the_change(faults, f"again-{number}")


@pytest.mark.parametrize("name", VERBS)
def test_a_kill_at_any_command_leads_to_rollback_or_completion_without_a_reboot(name: str, node: Sandbox) -> None:
    faults = Faults(node)
    before = VERBS[name][0]
    before(faults)
    keep = {directory: node.path(f"/harness/keep{directory}") for directory in ("/etc", "/tmp")}
    for directory, kept in keep.items():
        # the FIFO of `pause` is made again when it is needed
        shutil.copytree(node.path(directory), kept, symlinks=True, ignore=shutil.ignore_patterns("pause"))
    steps = len(do(faults, name).commands)
    gone_on_from: set[str] = set()
    for step in range(1, steps + 1):
        # `change` starts the processes that apply it
        node.close_processes()
        for directory, kept in keep.items():
            shutil.rmtree(node.path(directory))
            shutil.copytree(kept, node.path(directory), symlinks=True)
        label = f"killed before command {step}"
        killed = do(faults, name, kill_at=step)
        assert killed.killed, label
        if name == "restore":
            # the second timer, which was started beside the one that was killed, comes to its end
            node.deadman("guard", "c1", "0")
        elif name in {"arm", "change", "apply", "abort"}:
            node.deadman("abort", OWNER, "c1")
            # taking back is done by a process of its own, as the timer of the second kind is
            eventually(lambda: not node.processes())
            assert " state=idle " in node.deadman("status"), label
        if name == "confirm":
            again = node.deadman("confirm", "c1", NONCE)
            assert again == "ok state=idle id=c1 outcome=confirmed", label
            assert is_after(node.path("/etc")), label
            continue
        if name == "restore on boot":
            node.deadman("boot")
        assert is_before(node.path("/etc")), label
        settled = fingerprint(node.path("/etc"))
        if settled not in gone_on_from:
            gone_on_from.add(settled)
            make_the_change(faults, "again")
