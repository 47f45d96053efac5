"""Interrupted and resumed runs: Ctrl-C, `history`, `resume`; two operators on one robot."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import threading
from pathlib import Path

import pytest

from meshctl.fleet.interrupt import Interrupt
from meshctl.fleet.process import lock_owner
from meshctl.wording import lock_owners
from tests.meshctl.device.servers import PATIENCE_S, eventually
from tests.meshctl.robots.fleets import RobotFleet


class Finger:
    """Presses Ctrl-C so many times as soon as a file is there, each time when the one before was understood."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, there: Path, times: int) -> None:
        self._understood = threading.Semaphore(0)
        self._there = there
        self._times = times
        request = Interrupt.request

        def understood(interrupt: Interrupt) -> None:
            request(interrupt)
            self._understood.release()

        monkeypatch.setattr(Interrupt, "request", understood)
        self._thread = threading.Thread(target=self._press)

    def _press(self) -> None:
        eventually(self._there.exists)
        for _ in range(self._times):
            os.kill(os.getpid(), signal.SIGINT)
            assert self._understood.acquire(timeout=PATIENCE_S)

    def __enter__(self) -> None:
        self._thread.start()

    def __exit__(self, *exc: object) -> None:
        self._thread.join()


def test_an_interrupted_deploy_is_recorded_and_resume_continues_it(
    fleet: RobotFleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    fleet.add("husky1", fresh=True)
    fleet.add("husky2")
    fleet.write(parallel=1)
    with Finger(monkeypatch, fleet.directory / "husky1/upper/opt/udp-mesh/wheels", times=1):
        output = fleet.deploy(exit_code=130)
    assert "husky1: done" in output
    assert "husky2: pending: interrupted before it started" in output
    output = fleet.root_command("history")
    assert "robots deploy" in output
    assert "1 done, 1 pending" in output
    (run,) = json.loads(fleet.root_command("history", "--json"))
    output = fleet.root_command("history", str(run["run"]))
    for step in ("look", "send", "install", "switch"):
        assert step in output
    # another release meanwhile, and the same wheels without --wheels
    output = fleet.root_command("resume")
    assert "resuming run 1 (robots deploy): husky2" in output
    assert "husky2: done: runs " in output
    assert "run 2 is finished: nothing to resume" in fleet.root_command("resume")


@pytest.mark.proof
def test_a_second_ctrl_c_leaves_robots_intact_and_resumable(fleet: RobotFleet, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("husky1", "husky2"):
        fleet.add(name)
    fleet.write()
    fleet.machines["husky2"].stop()
    with Finger(monkeypatch, fleet.directory / "husky1/upper/opt/udp-mesh/unproven", times=2):
        output = fleet.deploy(exit_code=130)
    assert "husky1: uncertain" in output
    assert "husky2: unreachable" in output
    fleet.machines["husky2"].start()
    # the robot comes to the end of its switch by itself
    eventually(lambda: bool(fleet.status()["husky1"]["well"]))
    output = fleet.root_command("resume")
    assert "husky1: unchanged" in output
    assert "husky2: done: runs " in output


def test_a_live_lock_blocks_other_operators_and_a_stale_lock_does_not(fleet: RobotFleet) -> None:
    fleet.add("husky1")
    fleet.write()
    claim = 'echo "{owner} $(cut -d. -f1 /proc/uptime) $(cat /proc/sys/kernel/random/boot_id)" >/opt/udp-mesh/.claim'
    fleet.shell("husky1", "mkdir -p /opt/udp-mesh && " + claim.format(owner="ann@laptop:17:4711"))
    output = fleet.deploy(exit_code=1)
    assert "husky1 (10.42.0.10): locked by ann@laptop (process 17) for" in output
    assert "wait until it is done" in output

    with subprocess.Popen(["sleep", "600"]) as other:
        start = Path(f"/proc/{other.pid}/stat").read_text().rpartition(")")[2].split()[19]
        dead = f"{lock_owner().rsplit(':', 2)[0]}:{other.pid}:{start}"
        fleet.shell("husky1", claim.format(owner=dead))
        assert f"locked by {lock_owners(dead)}" in fleet.deploy(exit_code=1)
        other.kill()
        other.wait(PATIENCE_S)
    assert "husky1: done: runs " in fleet.deploy()
    assert fleet.shell("husky1", "ls /opt/udp-mesh/.claim 2>/dev/null || :") == ""
