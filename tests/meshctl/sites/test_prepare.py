"""How plans are asked for at sites whose uplinks come and go."""

from __future__ import annotations

import json
from pathlib import Path
from types import MappingProxyType, SimpleNamespace
from typing import Any, cast

import pytest

from meshctl.model import Fleet
from meshctl.nodes.connections import ConnectionPool
from meshctl.plan import NodePlan, Plan, Verdict
from meshctl.plan.saved import SavedPlan, dump
from meshctl.sites import dispatch
from meshctl.sites.bundle import SiteBundle
from meshctl.sites.dispatch import PLAN_ATTEMPTS, SitePlan, prepare_sites
from meshctl.sites.uplink import SiteOffline
from tests.meshctl.inventory.inventories import fleet_of

_NODES = """
    nats: {url: "nats://127.0.0.1:4222"}
    sites: {north: {nats: {}}}
    defaults: {hardware: rocket, radios: {radio0: {mesh: main}}, address: {rule: network + 10 + index}}
    nodes: {n1: {site: north}}
    """
_TEXT = dump(SavedPlan(Plan("trial", 1.0, (), MappingProxyType({"n1": NodePlan("n1", Verdict.SAME)})), b"salt" * 4, ""))


class Flapping:
    """The uplink of a site: it is there for the first `there` times that it is asked for, and lost in each plan but
    the last of them if that `ends_well`."""

    def __init__(self, there: int, *, ends_well: bool = False) -> None:
        self.left, self.ends_well = there, ends_well
        self.planned: list[str] = []
        self.closed = 0

    def open(self, fleet: Fleet, site: object, access: object, *, must_answer: bool = True) -> Any:
        if must_answer and self.left == 0:
            raise SiteOffline("site north does not answer over NATS")
        self.left -= must_answer
        return SimpleNamespace(plan=self._plan, send_images=lambda images: None, close=self._close)

    def _plan(self, run: str, *about: object) -> tuple[str, dict[str, object]]:
        self.planned.append(run)
        if self.ends_well and self.left == 0:
            return _TEXT, {}
        raise SiteOffline("site north does not answer over NATS: silent for 20 s")

    def _close(self) -> None:
        self.closed += 1


def _prepared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, uplink: Flapping, agreed: dict[str, str]) -> SitePlan:
    monkeypatch.setattr(dispatch, "open_uplink", uplink.open)
    monkeypatch.setattr(dispatch, "_FIRST_WAIT_S", 0.0)
    (made,) = prepare_sites(
        fleet_of(tmp_path, _NODES), {"north": ["n1"]}, cast("ConnectionPool", None),
        lambda site: SiteBundle(b"", {}, {}), (), agreed,
    )  # fmt: skip
    return made


@pytest.mark.parametrize("there", [0, 1, PLAN_ATTEMPTS])
def test_the_order_of_a_saved_plan_waits_also_for_a_site_whose_uplink_comes_and_goes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, there: int
) -> None:
    uplink = Flapping(there)
    made = _prepared(tmp_path, monkeypatch, uplink, {"north": _TEXT})
    assert (made.is_queued, made.error) == (True, None)
    assert json.loads(made.text) == json.loads(_TEXT)
    assert made.run not in uplink.planned, "what the site still has of it is not what is ordered"
    # one that was never there is not waited for
    assert len(uplink.planned) == there
    made.close()


def test_a_site_that_answers_in_the_end_has_a_plan(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    uplink = Flapping(3, ends_well=True)
    made = _prepared(tmp_path, monkeypatch, uplink, {"north": _TEXT})
    assert (made.is_queued, made.error, made.run) == (False, None, uplink.planned[-1])
    assert uplink.closed == 2


def test_a_site_that_cannot_plan_cannot_be_ordered_anything(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = _prepared(tmp_path, monkeypatch, Flapping(PLAN_ATTEMPTS), {})
    assert not made.is_queued
    assert isinstance(made.error, SiteOffline)
