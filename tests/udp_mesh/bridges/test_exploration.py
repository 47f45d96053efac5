"""The application of the system that inspired this one, as a peer written from its interface: two to four masters, a
task, a cut, and robots that carry home what another one found. Needs scripts/setup-ros.

The application itself was run by hand: docs/bridges.md says how, and what came of it. `benchmarks/exploration.py`
compares with the legacy transport.
"""

from __future__ import annotations

from contextlib import ExitStack

import pytest

from benchmarks.link.laboratory import Link
from tests.udp_mesh.bridges.exploration import (
    BASE,
    BEFORE,
    DURING,
    FIRST,
    TOPICS,
    Application,
    bring_together,
    mission,
    team_names,
)
from tests.udp_mesh.bridges.ros_team import team
from tests.waiting import until

pytestmark = pytest.mark.xdist_group("ros1")

LINK = Link(rate=5e6, delay_ms=5.0, loss=0.05)
SHORT_CUT_S, LONG_CUT_S = 5.0, 180.0
PHASE_WAIT_S = 120.0


def explores_and_comes_home(masters: int, cut_s: float) -> None:
    names = team_names(masters)
    with team(*names, link=LINK, topics=TOPICS) as (lab, members), ExitStack() as kept:
        found = {member.name: Application(member.master, member.name, names) for member in members}
        for application in found.values():
            kept.callback(application.close)
        base, first = found[BASE], found[FIRST]
        done = []
        for phase in mission(found, cut_s):
            bring_together(lab, names, phase.together)
            phase.begin()
            if phase.name == "ferry home":
                assert not base.has_all_of(first), "the base hears of it through the robots that carry alone"
            until(phase.is_over, f"{phase.name} of {', '.join(phase.together)}", wait_s=cut_s + PHASE_WAIT_S)
            done.append(phase.name)
        carried = ["ferry out"] * max(0, masters - 3) + ["ferry home"] * (masters - 2)
        assert done == ["connect", "cut", *carried, "home", "meet again"]
        robots = masters - 1
        assert base.items() == 2 * (robots * BEFORE + DURING)
        assert first.knows_the_task()


def test_everything_found_comes_home_through_a_robot_that_carries_it() -> None:
    explores_and_comes_home(3, SHORT_CUT_S)


@pytest.mark.proof
@pytest.mark.parametrize("masters", [2, 3, 4])
def test_everything_found_comes_home_after_minutes_without_a_link(masters: int) -> None:
    explores_and_comes_home(masters, LONG_CUT_S)
