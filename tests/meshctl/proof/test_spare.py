"""A spare takes over from a dead node, in a fleet of its own, which is not the same afterwards."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from meshctl.inventory import load_fleet
from tests.meshctl.proof.rig import Rig

pytestmark = [pytest.mark.lab, pytest.mark.xdist_group("rigs")]


def _pins(directory: Path) -> list[str]:
    return sorted(line for file in directory.glob("known_hosts*") for line in file.read_text().splitlines())


def test_a_spare_takes_over_a_dead_nodes_name_address_and_pin(tmp_path: Path) -> None:
    with Rig(tmp_path, 3) as rig:
        shown = rig.meshctl("bootstrap", "a", "n001", "--dry-run")
        assert (shown.code, "1 to change" in shown.out) == (0, True), shown.err
        # nothing pinned, nothing changed, nothing in the journal
        assert _pins(tmp_path) == []
        assert rig.fleet.node("n001").address == "192.168.1.1"
        assert json.loads(rig.meshctl("history", "", "--json").out) == []
        taken = rig.take_in("a")
        assert taken.code == 0, taken.out + taken.err
        inventory = rig.inventory("spare")
        text = rig.inventory("a").read_text(encoding="utf-8")
        spares = "".join(f"  n00{number}: {{state: spare, label: S{number}}}\n" for number in (2, 3))
        inventory.write_text(text + spares, encoding="utf-8")
        alive = rig.meshctl("replace", "spare", "n001", "n002", "--yes", "--json")
        assert "still answers" in alive.err
        rig.fleet.inject_fault("n001", "off")
        pins = _pins(tmp_path)
        shown = rig.meshctl("replace", "spare", "n001", "n002", "--dry-run")
        assert (shown.code, "becomes n001" in shown.out) == (0, True), shown.err
        assert "+  n001: {label: S2}" in shown.out, shown.out
        assert inventory.read_text(encoding="utf-8") == text + spares
        assert _pins(tmp_path) == pins
        assert rig.fleet.node("n002").address == "10.42.1.2"
        replaced = rig.meshctl("replace", "spare", "n001", "n002", "--yes", "--json")
        assert (replaced.code, replaced.results) == (0, {"n001": "done"}), replaced.out + replaced.err
        assert rig.fleet.node("n002").address == "10.42.1.1"
        fleet = load_fleet(inventory)
        assert (fleet.nodes["n001"].label, fleet.nodes["n002"].state.value) == ("S2", "retired")
        assert rig.meshctl("provision", "spare", "n001", "--check", "--json").verdicts == {"n001": "same"}
        # its successor dies, too, is marked as lost, and the inventory breaks while the next one takes over
        rig.fleet.inject_fault("n002", "off")
        good = inventory.read_text(encoding="utf-8").replace("n001: {label: S2}", "n001: {label: S2, state: lost}")
        inventory.write_text(good, encoding="utf-8")
        refused = rig.meshctl("replace", "spare", "n003", "n001", "--yes")
        assert "n001 is lost: expected a spare" in refused.err
        shown = rig.meshctl("replace", "spare", "n001", "n003", "--dry-run")
        assert (shown.code, "+  n001: {label: S3, state: deployed}" in shown.out) == (0, True), shown.out + shown.err
        with rig.start("replace", "spare", "n001", "n003", "--yes", "--json") as process:
            assert process.stdout is not None
            for line in process.stdout:
                if json.loads(line)["event"] == "step":
                    inventory.write_text(good + "nonsense: [", encoding="utf-8")
            assert process.stderr is not None
            stderr = process.stderr.read()
        assert process.returncode == 2, stderr
        assert "n001 runs on its new device, but the inventory could not be updated" in stderr
        assert '{"n001": {"label": "S3", "state": "deployed"}, "n003": {"state": "retired"}}' in stderr
        inventory.write_text(good, encoding="utf-8")
        assert rig.fleet.node("n003").address == "10.42.1.1"
        # the same command knows that its spare has taken over, and records it
        repeated = rig.meshctl("replace", "spare", "n001", "n003", "--yes", "--json")
        assert (repeated.code, repeated.results) == (0, {"n001": "unchanged"}), repeated.out + repeated.err
        fleet = load_fleet(inventory)
        assert (fleet.nodes["n001"].label, fleet.nodes["n003"].state.value) == ("S3", "retired")
        # what answers for n001 by now is no spare of anyone
        refused = rig.meshctl("replace", "spare", "n001", "bench", "--yes")
        assert "still answers" in refused.err
