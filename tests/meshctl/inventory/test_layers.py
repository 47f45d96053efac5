"""defaults < groups < range < node, against the obvious slow way to say it."""

from __future__ import annotations

import tempfile
from pathlib import Path

from hypothesis import given, settings
from hypothesis import strategies as st

from meshctl.model import LanFilter
from tests.meshctl.inventory.inventories import HEAD, fleet_of, load_text

_GROUPS = ("g0", "g1", "g2", "g3")
# What a layer may say: drive level, port, label.
_Layer = dict[str, int]
_LAYERS = st.dictionaries(st.sampled_from(["power", "port", "label"]), st.integers(1, 28), max_size=3)


def _body(layer: _Layer) -> str:
    parts = []
    if "power" in layer:
        parts.append(f"radios: {{radio0: {{tx_power_dbm: {layer['power']}}}}}")
    if "port" in layer:
        parts.append(f"ssh: {{port: {layer['port']}}}")
    if "label" in layer:
        parts.append(f"label: L{layer['label']}")
    return ", ".join(parts)


def _flatten(groups: list[str], parents: dict[str, list[str]]) -> list[str]:
    """Farthest first: a group's parents before it, each group at its first mention."""
    order: list[str] = []
    for group in groups:
        for name in (*_flatten(parents[group], parents), group):
            if name not in order:
                order.append(name)
    return order


@given(
    defaults=_LAYERS,
    bodies=st.lists(_LAYERS, min_size=4, max_size=4),
    inherits=st.lists(st.lists(st.integers(0, 3), max_size=3, unique=True), min_size=4, max_size=4),
    groups=st.lists(st.sampled_from(_GROUPS), max_size=3, unique=True),
    ranged=_LAYERS,
    own=_LAYERS,
)
@settings(max_examples=80)
def test_the_nearest_layer_wins(
    defaults: _Layer,
    bodies: list[_Layer],
    inherits: list[list[int]],
    groups: list[str],
    ranged: _Layer,
    own: _Layer,
) -> None:
    # A group inherits from groups of lower number only, so there is no circle.
    parents = {f"g{n}": [f"g{m}" for m in above if m < n] for n, above in enumerate(inherits)}
    text = f"{HEAD}defaults: {{{_body(defaults)}}}\ngroups:\n"
    for number, name in enumerate(_GROUPS):
        body = f", {_body(bodies[number])}" if bodies[number] else ""
        text += f"  {name}: {{inherits: [{', '.join(parents[name])}]{body}}}\n"
    ranged_body = f", {_body(ranged)}" if ranged else ""
    text += "nodes:\n  n[1-2]: {hardware: rocket, address: {from: 10.42.0.1}, "
    text += f"groups: [{', '.join(groups)}]{ranged_body}}}\n  n1: {{{_body(own)}}}\n"

    expected: _Layer = {}
    order = [bodies[int(name[1])] for name in _flatten(groups, parents)]
    for layer in (defaults, *order, ranged, own):
        expected.update(layer)

    with tempfile.TemporaryDirectory() as directory:
        loaded = load_text(Path(directory), text)
    assert loaded.fleet is not None, loaded.diagnostics
    node = loaded.fleet.nodes["n1"]
    assert node.radios[0].tx_power_dbm == expected.get("power", 28)
    assert node.ssh.port == expected.get("port", 22)
    assert node.label == (f"L{expected['label']}" if "label" in expected else "")


def test_a_lan_filter_of_defaults_is_removed_or_replaced_by_a_nearer_layer(tmp_path: Path) -> None:
    text = """
    defaults: {hardware: rocket, lan_filter: {udp_ports: [5353]}}
    nodes:
      b01: {address: 10.42.0.11}
      b02: {address: 10.42.0.12, lan_filter: null}
      b03: {address: 10.42.0.13, lan_filter: {}}
    """
    fleet = fleet_of(tmp_path, text)
    assert [node.lan_filter for node in fleet.nodes.values()] == [LanFilter((5353,)), None, LanFilter()]


def test_a_gateway_of_defaults_is_removed_by_a_nearer_layer(tmp_path: Path) -> None:
    text = """
    defaults: {hardware: rocket, gateway: 10.42.0.1}
    nodes: {b01: {address: 10.42.0.11}, b02: {address: 10.42.0.1, gateway: null}}
    """
    fleet = fleet_of(tmp_path, text)
    assert [str(node.gateway) for node in fleet.nodes.values()] == ["10.42.0.1", "None"]
