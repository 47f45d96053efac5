"""A spare takes over from a dead node. Last of all, because the fleet is not the same afterwards."""

from __future__ import annotations

import pytest

from meshctl.inventory import load_fleet
from tests.meshctl.proof.rig import Rig

pytestmark = [pytest.mark.lab, pytest.mark.xdist_group("lab"), pytest.mark.timeout(600)]


def test_a_spare_takes_over_a_dead_nodes_name_address_and_pin(rig: Rig) -> None:
    inventory = rig.inventory("spare")
    text = rig.inventory(rig.current).read_text(encoding="utf-8")
    inventory.write_text(text + "  n003: {state: spare, label: S1}\n", encoding="utf-8")
    alive = rig.meshctl("replace", "spare", "n002", "n003", "--yes", "--json")
    assert "still answers" in alive.err
    rig.fleet.break_("n002", "off")
    replaced = rig.meshctl("replace", "spare", "n002", "n003", "--yes", "--json")
    assert (replaced.code, replaced.results) == (0, {"n002": "done"}), replaced.out + replaced.err
    assert rig.fleet.node("n003").address == "10.42.1.2"
    fleet = load_fleet(inventory)
    assert (fleet.nodes["n002"].label, fleet.nodes["n003"].state.value) == ("S1", "retired")
    assert rig.meshctl("provision", "spare", "n002", "--check", "--json").verdicts == {"n002": "same"}
