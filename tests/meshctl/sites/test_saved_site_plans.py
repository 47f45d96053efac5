"""A saved plan of several sites is read back as it was written, and refused for other fleets and other sites."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

import pytest

from meshctl.cli.saved_site_plans import SavedSitePlans, Unplanned, check_placement, dump_site_plans, load_site_plans
from meshctl.errors import InputError
from meshctl.plan import NodePlan, Plan, Verdict
from meshctl.plan.saved import SavedPlan, dump
from tests.meshctl.inventory.inventories import fleet_of

_NODES = """
    sites: {north: {ssh: {host: north.example.org}}, south: {ssh: {host: south.example.org}}}
    defaults: {hardware: rocket, radios: {radio0: {mesh: main}}, address: {rule: network + 10 + index}}
    nodes: {n1: {site: north}, s1: {site: south}, lone: {}}
    """


def _plan(*names: str) -> SavedPlan:
    nodes = {name: NodePlan(name, Verdict.SAME) for name in names}
    return SavedPlan(Plan("trial", 1.0, (), MappingProxyType(nodes)), b"salt" * 4, "fleet.yaml", with_firmware=False)


_PLANS = SavedSitePlans("trial", _plan("lone"), {"north": _plan("n1")}, {"south": Unplanned(("s1",), "no answer")})


def test_saved_plans_are_read_back_as_they_were_written() -> None:
    for plans in (_PLANS, replace(_PLANS, direct=None), replace(_PLANS, sites={}, unplanned={})):
        assert load_site_plans(dump_site_plans(plans), "plan.json") == plans
    assert not _PLANS.with_firmware


def test_a_plan_without_sites_is_none_of_several_sites() -> None:
    for text in (dump(_plan("lone")), "", "[]", "{}", "null"):
        assert load_site_plans(text, "plan.json") is None


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        ({"version": 2}, "expected plans of version 1, found 2"),
        ({"sites": 5}, "damaged plan"),
        ({"sites": {"north": 5}}, "damaged plan"),
        ({"sites": {"north": {"error": "no answer"}}}, "'nodes' is missing"),
        ({"sites": {"north": {}}}, "plan.json, site north: expected a plan"),
        ({"direct": []}, "expected a plan"),
    ],
)
def test_damaged_plans_are_refused_with_the_fault(changed: dict[str, object], reason: str) -> None:
    with pytest.raises(InputError, match=reason):
        load_site_plans(json.dumps(json.loads(dump_site_plans(_PLANS)) | changed), "plan.json")


def test_plans_are_for_the_fleet_and_the_workers_that_made_them(tmp_path: Path) -> None:
    fleet = fleet_of(tmp_path, _NODES)
    check_placement(_PLANS, fleet, "plan.json")
    with pytest.raises(InputError, match="for fleet other"):
        check_placement(replace(_PLANS, fleet="other"), fleet, "plan.json")
    for sites, unplanned in (
        ({"south": _plan("n1")}, {}),
        ({"north": _plan("gone")}, {}),
        ({}, {"east": _PLANS.unplanned["south"]}),
    ):
        with pytest.raises(InputError, match="no longer provisions"):
            check_placement(replace(_PLANS, sites=sites, unplanned=unplanned), fleet, "plan.json")
