"""Fixed positions of nodes and robots."""

from __future__ import annotations

from pathlib import Path

import pytest

from meshctl.errors import InputError
from meshctl.inventory import load_fleet
from meshctl.model import FixedPosition
from tests.meshctl.status.fleets import INVENTORY


def written(tmp_path: Path, old: str, new: str) -> Path:
    path = tmp_path / "fleet.yaml"
    assert old in INVENTORY
    path.write_text(INVENTORY.replace(old, new))
    return path


def test_nodes_and_robots_may_have_a_position(tmp_path: Path) -> None:
    path = written(tmp_path, "address: 10.42.0.2}", "address: 10.42.0.2, position: {x_m: 12.5, y_m: -3}}")
    path.write_text(path.read_text().replace("is_base: true,", "is_base: true, position: {x_m: 0, y_m: 0, z_m: 1.5},"))
    fleet = load_fleet(path)
    assert fleet.nodes["b01"].position == FixedPosition(12.5, -3.0, None)
    assert (fleet.nodes["base"].position, fleet.robots["rover"].position) == (None, None)
    assert fleet.robots["station"].position == FixedPosition(0.0, 0.0, 1.5)


@pytest.mark.parametrize(
    ("position", "message"),
    [
        ("{x_m: 1}", "y_m"),
        ("{x_m: .nan, y_m: 0}", "x_m"),
        ("{x_m: .inf, y_m: 0}", "x_m"),
        ("{x_m: 2e6, y_m: 0}", "x_m"),
        ("{x_m: north, y_m: 0}", "x_m"),
        ("{x_m: 1, y_m: 2, lat: 3}", "lat"),
        ("[1, 2]", "position"),
    ],
)
def test_nonsense_is_rejected_where_it_is_written(tmp_path: Path, position: str, message: str) -> None:
    path = written(tmp_path, "address: 10.42.0.2}", f"address: 10.42.0.2, position: {position}}}")
    with pytest.raises(InputError, match=rf"fleet\.yaml:\d+:\d+.*{message}"):
        load_fleet(path)
