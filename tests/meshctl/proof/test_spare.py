"""A spare takes over from a dead node, in a fleet of its own, which is not the same afterwards."""

from __future__ import annotations

from pathlib import Path

import pytest

from meshctl.inventory import load_fleet
from tests.meshctl.proof.rig import Rig

pytestmark = [pytest.mark.lab, pytest.mark.xdist_group("lab"), pytest.mark.timeout(600)]


def test_a_spare_takes_over_a_dead_nodes_name_address_and_pin(tmp_path: Path) -> None:
    with Rig(tmp_path, 2) as rig:
        taken = rig.take_in("a")
        assert taken.code == 0, taken.out + taken.err
        inventory = rig.inventory("spare")
        text = rig.inventory("a").read_text(encoding="utf-8")
        inventory.write_text(text + "  n002: {state: spare, label: S1}\n", encoding="utf-8")
        alive = rig.meshctl("replace", "spare", "n001", "n002", "--yes", "--json")
        assert "still answers" in alive.err
        rig.fleet.break_("n001", "off")
        replaced = rig.meshctl("replace", "spare", "n001", "n002", "--yes", "--json")
        assert (replaced.code, replaced.results) == (0, {"n001": "done"}), replaced.out + replaced.err
        assert rig.fleet.node("n002").address == "10.42.1.1"
        fleet = load_fleet(inventory)
        assert (fleet.nodes["n001"].label, fleet.nodes["n002"].state.value) == ("S1", "retired")
        assert rig.meshctl("provision", "spare", "n001", "--check", "--json").verdicts == {"n001": "same"}
