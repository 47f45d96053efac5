"""Plans of several sites: a refusal that ends the command is said once, as its error."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from meshctl.apply.prepare import Prepared
from meshctl.cli.plan_execution import PlanRefused
from meshctl.cli.site_runs import WholePlan, confirm_everywhere, show_everywhere
from meshctl.model import Site
from meshctl.nodes.collect import FleetObservation
from meshctl.plan import NodePlan, Plan, Verdict
from meshctl.plan.saved import SavedPlan
from meshctl.sites.dispatch import SitePlan

OPENED: Any = SimpleNamespace(fleet=SimpleNamespace(nodes={}))


def made(name: str, refusal: str = "") -> Plan:
    node = NodePlan(name, Verdict.SAME)
    return Plan("team", 0.0, (), {name: node}, refusal=refusal, refusal_hint="wait")


def site(name: str, refusal: str = "") -> SitePlan:
    return SitePlan(Site(name), (name,), "run", SavedPlan(made(name, refusal), b"", "fleet.yaml"))


def whole(own: str | None, *sites: SitePlan) -> WholePlan:
    direct = None if own is None else Prepared(made("base", own), {}, FleetObservation({}, {}))
    return WholePlan(direct, sites)


@pytest.mark.parametrize(
    ("plan", "raised", "shown"),
    [
        (whole("own base is away", site("north", "a quorum is away")), "own base is away", ["a quorum is away"]),
        (whole(None, site("north", "a quorum is away"), site("south", "no base")), "a quorum is away", ["no base"]),
        (whole(None, site("north", "a quorum is away")), "a quorum is away", []),
        (whole("", site("north", "a quorum is away")), None, ["a quorum is away"]),
    ],
)
def test_the_refusal_that_ends_the_command_is_not_shown_before_it(
    plan: WholePlan, raised: str | None, shown: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    show_everywhere(OPENED, plan, brief=True, raised=plan.refusal)
    printed = capsys.readouterr().out.splitlines()
    assert [line.removeprefix("refused: ") for line in printed if line.startswith("refused: ")] == shown
    if raised is None:
        confirm_everywhere(OPENED, plan, yes=True)
        return
    with pytest.raises(PlanRefused, match=raised):
        confirm_everywhere(OPENED, plan, yes=True)
