"""A radio interface that its configuration has turned off, but that is on the air, as an earlier version left it."""

from __future__ import annotations

from dataclasses import replace

import pytest

from meshctl.apply.change_set import change_of, reload_script
from meshctl.apply.health_checks import expectation, unmet
from meshctl.device.deadman import bundle
from meshctl.device.observation import Observation, WirelessLink
from meshctl.plan import Cut, Verdict
from meshctl.plan.build import fleet_plan
from meshctl.plan.left_over import left_over
from meshctl.plan.saved import SavedPlan, dump, load
from tests.meshctl.plan.support import SALT, fleet, graph, planned, running, wanted

ON_THE_AIR = WirelessLink("mesh1", "IBSS", ssid="team", channel=6, joined=True)


def with_links(*links: WirelessLink) -> Observation:
    mesh0 = WirelessLink("mesh0", "IBSS", ssid="team", bssid="02:ca:fe:00:00:01", channel=6, joined=True)
    return replace(running(fleet(), "b01"), links=(mesh0, *links))


@pytest.mark.parametrize(
    ("link", "names"),
    [
        (ON_THE_AIR, ("mesh1",)),
        (replace(ON_THE_AIR, mode="mesh point"), ("mesh1",)),
        # not ours
        (replace(ON_THE_AIR, ifname="wlan1"), ()),
        (replace(ON_THE_AIR, mode="monitor"), ()),
    ],
)
def test_a_mesh_interface_that_no_enabled_section_names_is_left_over(
    link: WirelessLink, names: tuple[str, ...]
) -> None:
    assert left_over(with_links(link)) == names


def test_nothing_is_left_over_where_the_configuration_leaves_a_name_to_openwrt() -> None:
    seen = with_links(ON_THE_AIR)
    assert seen.uci is not None
    unnamed = seen.uci["wireless"] + "config wifi-iface 'other'\n\toption device 'radio0'\n\toption mode 'adhoc'\n"
    for text in (unnamed, "config 'unreadable"):
        assert left_over(replace(seen, uci={**seen.uci, "wireless": text})) == ()


def test_a_plan_takes_it_down_although_no_file_differs() -> None:
    seen = with_links(ON_THE_AIR)
    plan = planned(fleet(), "b01", seen)
    assert (plan.verdict, plan.files, plan.left_over, plan.cut) == (Verdict.CHANGE, (), ("mesh1",), Cut.MESH)
    assert [effect.service for effect in plan.effects] == ["wifi"]
    assert "mesh1" in plan.effects[0].why
    change = change_of("c1", plan, wanted(fleet(), "b01"), seen, ())
    assert (change.files, change.reload) == ({}, reload_script({"etc/config/wireless"}, ()))
    assert bundle(change)
    assert planned(fleet(), "b01", with_links()).verdict is Verdict.SAME


def test_a_change_of_another_file_takes_it_down_too() -> None:
    seen = with_links(ON_THE_AIR)
    assert seen.uci is not None
    seen = replace(seen, uci={**seen.uci, "system": ""})
    change = change_of("c1", planned(fleet(), "b01", seen), wanted(fleet(), "b01"), seen, ())
    assert set(change.files) == {"/etc/config/system"}
    assert change.reload == reload_script({"etc/config/system", "etc/config/wireless"}, ())


def test_it_must_be_gone_before_the_change_is_confirmed() -> None:
    before = with_links(ON_THE_AIR)
    expected = expectation(wanted(fleet(), "b01"), before)
    assert "mesh1 should be off, but still exists" in unmet(expected, before)
    assert "mesh1 should be off, but still exists" not in unmet(expected, with_links())


def test_a_saved_plan_keeps_it() -> None:
    plan = fleet_plan(fleet(), {"b01": planned(fleet(), "b01", with_links(ON_THE_AIR))}, graph("base-b01"), now_s=0.0)
    assert plan.stages
    text = dump(SavedPlan(plan, SALT, "inventory"))
    assert load(text, "plan.json").plan.nodes["b01"].left_over == ("mesh1",)
    # of an earlier version
    older = text.replace('"left_over": [\n    "mesh1"\n   ],', "")
    assert older != text
    assert load(older, "plan.json").plan.nodes["b01"].left_over == ()
