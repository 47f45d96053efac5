"""Which node a MAC address belongs to."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

from meshctl.cli.bootstrap import _identity_changes
from meshctl.fleet.journal import LastKnown
from meshctl.inventory import load_fleet
from meshctl.inventory.starter import write_starter
from meshctl.model import NodeState
from meshctl.nodes.collect import known_macs
from tests.meshctl.plan.support import fleet

MAC = "02:4d:00:00:00:01"


def test_a_retired_spare_does_not_claim_the_mac_of_the_replacement_device() -> None:
    """After `meshctl replace b01 b05`, both names have the same MAC in the journal."""
    team = fleet()
    known = {name: LastKnown(name, 100.0, {"macs": MAC}) for name in ("b01", "b05")}
    retired = replace(team.nodes["b05"], state=NodeState.RETIRED)
    team = replace(team, nodes=MappingProxyType({**team.nodes, "b05": retired}))
    assert known_macs(team, known)[MAC] == "b01"


def test_the_old_device_s_radio_macs_leave_the_inventory(tmp_path: Path) -> None:
    write_starter(tmp_path)
    file = tmp_path / "fleet.yaml"
    entry = f"  base: {{role: base, address: 10.42.0.1, radios: {{radio0: {{mac: '{MAC}'}}}}}}\n"
    file.write_text(file.read_text().replace("  base: {role: base, address: 10.42.0.1}\n", entry))
    node = load_fleet(tmp_path).nodes["base"]
    found: Any = None
    (change,) = _identity_changes(tmp_path, node, None, found, {"label": "S2"}, {})
    assert MAC not in change.after
    assert "label: S2" in change.after
