"""The mission of `exploring_robot` for two to four masters: connect, a task, a cut, ferries, and all meet again.

The base and the robots have names as BOBCAT gives them. In the cut all are alone but the base and the last robot. That
one leaves the base with a task for the first, passes it on to the next one when they meet, and so on; what the first
found comes home the same way. Used by the test and by the comparison in `benchmarks/exploration`.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.link.laboratory import Laboratory
from tests.udp_mesh.bridges.bridge_processes import NodeProcess
from tests.udp_mesh.bridges.interpreters import ROS_PYTHON
from tests.udp_mesh.bridges.ros1_processes import Master

BASE, FIRST = "Base", "H01"
TASK = "go home"
ARTIFACT_BYTES, MAP_BYTES = 30_000, 20_000
BEFORE, DURING = 3, 4
"""How many artifacts, and map differences, each robot finds before the cut, and the first one during it."""
ROBOT = Path(__file__).with_name("exploring_robot.py")
PRIORITIES = {"ma_data": 4, "dm_request": 5, "dm_response": 7}
"""Of the application's topics."""
TOPICS = (
    "[topics]\n"
    f"ma_data = {{ priority = {PRIORITIES['ma_data']}, keep_last = 1 }}\n"
    f"dm_request = {{ priority = {PRIORITIES['dm_request']} }}\n"
    f"dm_response = {{ priority = {PRIORITIES['dm_response']} }}\n"
)
"""The same for the daemons."""


def team_names(masters: int) -> tuple[str, ...]:
    return (BASE, *(f"H{number:02}" for number in range(1, masters)))


class Application(NodeProcess):
    """The application on one computer."""

    def __init__(self, master: Master, name: str, names: Sequence[str]) -> None:
        others = [each for each in names if each != name]
        command = [*master.inside, ROS_PYTHON, str(ROBOT), name, *others]
        super().__init__(command, master.environment, master.folder / f"{name}-application.log")
        self.name = name
        self._found = 0

    def explore(self, count: int) -> None:
        """Finds so many artifacts, and as many map differences."""
        for number in range(self._found, self._found + count):
            self._command(found=f"{self.name} artifact {number}", bytes=ARTIFACT_BYTES)
            self._command(found=f"{self.name} map {number}", bytes=MAP_BYTES)
        self._found += count

    def assign(self, robot: str, task: str) -> None:
        self._command(task=task, robot=robot)

    def report(self) -> dict[str, Any]:
        self._command(report=True)
        return dict(self.expect("report")["report"])

    def hears(self) -> list[str]:
        return list(self.report()["hears"])

    def knows_the_task(self) -> bool:
        return bool(self.report()["tasks"].get(FIRST) == TASK)

    def has_all_of(self, other: Application) -> bool:
        """Whether it has whatever this robot found, byte for byte."""
        return bool(self.report()["items"][other.name] == other.report()["items"][other.name])

    def items(self) -> int:
        """How many artifacts and map differences of other robots it has."""
        return sum(len(found) for robot, found in self.report()["items"].items() if robot != self.name)


@dataclass(frozen=True, slots=True)
class Phase:
    """Bring `together` in reach of one another (the others are alone), `begin`, and go on when `is_over`."""

    name: str
    together: tuple[str, ...]
    is_over: Callable[[], bool]
    begin: Callable[[], None] = lambda: None


def mission(found: Mapping[str, Application], cut_s: float) -> Iterator[Phase]:
    """The phases, in order. A caller may give up waiting for one, and takes the next."""
    names = tuple(found)
    base, robots = found[BASE], [found[name] for name in names[1:]]
    first, last = robots[0], robots[-1]

    def explore() -> None:
        for robot in robots:
            robot.explore(BEFORE)

    yield Phase("connect", names, lambda: all(base.has_all_of(robot) for robot in robots), explore)
    began_s = time.monotonic()

    def lose_the_first() -> None:
        first.explore(DURING)
        base.assign(FIRST, TASK)

    def is_cut() -> bool:
        is_given = last is first or last.knows_the_task()
        return time.monotonic() - began_s >= cut_s and is_given and first.hears() == []

    yield Phase("cut", (BASE,) if last is first else (BASE, last.name), is_cut, lose_the_first)
    pairs = list(itertools.pairwise(robots))
    for farther, carrier in reversed(pairs[1:]):
        yield Phase("ferry out", (farther.name, carrier.name), farther.knows_the_task)

    for farther, carrier in pairs:

        def carries(carrier: Application = carrier) -> bool:
            return carrier.has_all_of(first) and first.knows_the_task()

        yield Phase("ferry home", (farther.name, carrier.name), carries)

    def is_home() -> bool:
        return base.has_all_of(first) and FIRST in base.report()["taken"]

    yield Phase("home", (BASE, last.name), is_home)

    def all_meet() -> bool:
        return all(len(each.hears()) == len(names) - 1 for each in found.values()) and is_home()

    yield Phase("meet again", names, all_meet)


def bring_together(lab: Laboratory, names: Sequence[str], together: Sequence[str]) -> None:
    lab.bring_together([names.index(name) for name in together])
