"""Replace a dead beacon by a factory-fresh device, which gets its name and its place in the mesh."""

from __future__ import annotations

import pytest

from meshctl.inventory import load_fleet
from tests.meshlab.qemu.conftest import until
from tests.meshlab.qemu.team.conftest import Team

pytestmark = [pytest.mark.lab, pytest.mark.xdist_group("lab-real-team"), pytest.mark.timeout(1800)]


def test_a_factory_fresh_device_takes_over_a_dead_beacons_name_and_place(team: Team) -> None:
    until(lambda: team.originators("base").get("husky") == "b01", "the route over the node to replace")
    place = team.node("spare").bench
    alive = team.meshctl("replace", "b01", "spare", "--at", f"{place.host}:{place.port}", "--yes", expect=None)
    assert "still answers" in alive.errors
    team.fleet.inject_fault("b01", "off")
    done = team.meshctl("replace", "b01", "spare", "--at", f"{place.host}:{place.port}", "--yes", "--json")
    assert {event["outcome"]["result"] for event in done.events if event["event"] == "finished"} == {"done"}
    team.node("spare").plug(False)
    # the new device is at the old one's place, with the settings of the mesh
    until(lambda: team.originators("base").get("husky") == "spare", "the route over the new device")
    until(lambda: team.answers("base-station", "10.42.0.10"), "the Husky's computer to answer")
    assert team.on("spare", "uci get system.@system[0].hostname").strip() == "b01"
    assert team.node("spare").address == "10.42.0.101"
    fleet = load_fleet(team.inventory)
    assert (fleet.nodes["b01"].label, fleet.nodes["spare"].state.value) == ("S1", "retired")
    until(lambda: team.meshctl("provision", "b01", "--check", expect=None).status == 0, "nothing left to change")
