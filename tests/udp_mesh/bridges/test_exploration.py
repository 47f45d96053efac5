"""The application of the system that inspired this one, as a peer written from its interface: three masters, a task, a
cut, and a robot that carries home what another one found. Needs scripts/setup-ros.

The application itself was run by hand: docs/bridges.md says how, and what came of it.
"""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from benchmarks.link.laboratory import INTERFACE, Laboratory, Link
from tests.udp_mesh.bridges.bridge_processes import NodeProcess
from tests.udp_mesh.bridges.interpreters import ROS_PYTHON
from tests.udp_mesh.bridges.ros1_processes import Master
from tests.udp_mesh.bridges.ros_team import team
from tests.udp_mesh.daemon.processes import poll

pytestmark = [pytest.mark.proof, pytest.mark.xdist_group("ros1")]

NAMES = ("Base", "H01", "H02")
ROBOT = Path(__file__).with_name("exploring_robot.py")
LINK = Link(rate=5e6, delay_ms=5.0, loss=0.05)
TOPICS = """
[topics]
ma_data = { priority = 4, keep_last = 1 }
dm_request = { priority = 5 }
dm_response = { priority = 7 }
"""
ARTIFACT_BYTES, MAP_BYTES = 30_000, 20_000


class Application(NodeProcess):
    """The application on one computer."""

    def __init__(self, master: Master, name: str) -> None:
        others = [each for each in NAMES if each != name]
        command = [*master.inside, ROS_PYTHON, str(ROBOT), name, *others]
        super().__init__(command, master.environment, master.folder / f"{name}-application.log")

    def find(self, name: str, size_bytes: int) -> None:
        self._command(found=name, bytes=size_bytes)

    def assign(self, robot: str, task: str) -> None:
        self._command(task=task, robot=robot)

    def report(self) -> dict[str, Any]:
        self._command(report=True)
        return dict(self.expect("report")["report"])

    def has_all_of(self, other: Application, robot: str) -> bool:
        """Whether it has whatever this robot found, byte for byte."""
        return bool(self.report()["items"][robot] == other.report()["items"][robot])


@contextmanager
def applications() -> Iterator[tuple[Laboratory, dict[str, Application]]]:
    with team(*NAMES, link=LINK, topics=TOPICS) as (lab, members):
        found = {member.name: Application(member.master, member.name) for member in members}
        try:
            yield lab, found
        finally:
            for application in found.values():
                application.close()


def reach(lab: Laboratory, *names: str) -> None:
    """Bring these in reach of one another, and the others out of reach."""
    for name, namespace in zip(NAMES, lab.namespaces, strict=True):
        state = "up" if name in names else "down"
        subprocess.run(["ip", "-n", namespace, "link", "set", INTERFACE, state], check=True)


def test_everything_found_comes_home_though_its_finder_never_meets_the_base_again() -> None:
    with applications() as (lab, found):
        base, first, second = (found[name] for name in NAMES)
        for number in range(3):
            for name, application in (("H01", first), ("H02", second)):
                application.find(f"{name} artifact {number}", ARTIFACT_BYTES)
                application.find(f"{name} map {number}", MAP_BYTES)
        for name, application in (("H01", first), ("H02", second)):
            poll(lambda a=application, n=name: base.has_all_of(a, n), f"the base has what {name} found")  # type: ignore[misc]
        reach(lab, "Base", "H02")
        poll(lambda: first.report()["hears"] == [], "H01 is alone")
        base.assign("H01", "go home")
        for number in range(3, 7):
            first.find(f"H01 artifact {number}", ARTIFACT_BYTES)
            first.find(f"H01 map {number}", MAP_BYTES)
        poll(lambda: second.report()["tasks"].get("H01") == "go home", "H02 knows the task of H01")
        reach(lab, "H01", "H02")
        poll(lambda: second.has_all_of(first, "H01"), "H02 carries what H01 found")
        poll(lambda: first.report()["tasks"].get("H01") == "go home", "the task of the base reached H01 through H02")
        assert not base.has_all_of(first, "H01")
        reach(lab, "Base", "H02")
        poll(lambda: base.has_all_of(first, "H01"), "H02 brought home what H01 found")
        reach(lab, *NAMES)
        poll(lambda: first.report()["hears"] == ["Base", "H02"], "all meet again")
