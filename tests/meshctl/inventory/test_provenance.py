"""Every value knows its place."""

from __future__ import annotations

from pathlib import Path

import pytest

from meshctl.inventory import load_fleet
from meshctl.inventory.explain import explain
from meshctl.model import Fleet, MissingOrigin
from tests.meshctl.inventory.inventories import SHIPPED, fleet_of


@pytest.fixture(scope="module")
def final() -> Fleet:
    return load_fleet(SHIPPED / "subt-final")


def test_an_origin_points_at_the_value_or_its_key(final: Fleet) -> None:
    lines = {file: Path(file).read_text().splitlines() for file in final.files}
    seen = 0
    for path, origin in final.provenance.items():
        place = origin.position
        rest = lines[place.file][place.line - 1][place.column - 1 :]
        if path[-1].isdigit() or path[-1] == "robot" or (path[0] == "nodes" and len(path) == 2):
            continue
        is_key = rest.startswith((f"{path[-1]}:", f'"{path[-1]}"'))
        value_line = lines[place.file][place.line - 1]
        assert is_key or f"{path[-1]}:" in value_line[: place.column], (path, rest)
        seen += 1
    assert seen > 400


def test_iteration_and_lookup_agree(final: Fleet) -> None:
    paths = list(final.provenance)
    assert len(paths) == len(set(paths)) == len(final.provenance)
    assert all(final.provenance[path].position.line > 0 for path in paths)
    assert ("nodes", "husky1-b07") not in final.provenance
    assert () not in final.provenance


@pytest.mark.parametrize(
    ("path", "layer"),
    [
        (("nodes", "husky1-b03", "radios", "radio0", "tx_power_dbm"), "group beacons"),
        (("nodes", "husky1-b03", "address"), "rule"),
        (("nodes", "husky1-b03"), "range husky1-b[01-06]"),
        (("nodes", "husky1-b03", "label"), "range husky1-b[01-06]"),
        (("nodes", "base", "state"), "defaults"),
        (("nodes", "base", "address"), "node"),
        (("meshes", "main", "channel"), "mesh main"),
        (("hardware", "rocket", "radios", "radio0", "rated_power_dbm"), "hardware rocket"),
        (("topics", "emergency_stop", "priority"), "topic emergency_stop"),
        (("robots", "husky1", "computer", "address"), "robot husky1"),
        (("udp_mesh", "port"), "fleet"),
        (("operators", "ssh_keys", "0"), "fleet"),
        (("groups", "beacons", "role"), "group beacons"),
        (("country",), "fleet"),
    ],
)
def test_an_origin_names_the_layer(final: Fleet, path: tuple[str, ...], layer: str) -> None:
    assert final.where(*path).layer == layer


def test_an_unknown_path_raises_missing_origin(final: Fleet) -> None:
    with pytest.raises(MissingOrigin):
        final.where("weather", "today")


def test_explain_names_the_layer_of_every_value(tmp_path: Path) -> None:
    text = """\
        defaults: {hardware: rocket}
        groups: {g: {state: carried, extra_uci: {wireless.radio0.rts: "500"}}}
        nodes:
          n: {groups: [g], address: 10.42.0.1}
        """
    fleet = fleet_of(tmp_path, text)
    whys = {why.key: why for why in explain(fleet, fleet.nodes["n"])}
    assert {key: whys[key].origin.layer for key in ("hardware", "state", "address", "board", "radios.radio0.mesh")} == {
        "hardware": "defaults",
        "state": "group g",
        "address": "node",
        "board": "hardware rocket",
        "radios.radio0.mesh": "built-in",
    }
    assert whys["extra_uci.wireless.radio0.rts"].value == "500"
    assert whys["extra_uci.wireless.radio0.rts"].origin.position.line == 15


def test_without_defaults_a_node_has_provenance_only_for_its_own_values(tmp_path: Path) -> None:
    fleet = fleet_of(tmp_path, "nodes: {n: {hardware: rocket, address: 10.42.0.1}}\n")
    assert {path for path in fleet.provenance if path[0] == "nodes"} == {
        ("nodes",),
        ("nodes", "n"),
        ("nodes", "n", "hardware"),
        ("nodes", "n", "address"),
    }
