"""docs/inventory.md says what the code does."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from meshctl.inventory import include, source
from meshctl.inventory.codes import MAX_DIAGNOSTICS, MEANINGS
from meshctl.inventory.compose import MAX_DEPTH, MAX_VALUES
from meshctl.inventory.documents import InventoryDocument
from meshctl.inventory.ranges import MAX_NAMES, expand
from meshctl.model import NodeState
from tests.meshctl.inventory.inventories import HEAD, SHIPPED, load_text

_TEXT = (SHIPPED.parent / "docs" / "inventory.md").read_text()


def _examples() -> list[str]:
    return re.findall(r"```yaml\n(.*?)```", _TEXT, re.DOTALL)


def test_every_diagnostic_code_is_documented() -> None:
    rows = dict(re.findall(r"^\| (INV\d{3}) \| (.*) \|$", _TEXT, re.MULTILINE))
    assert rows == MEANINGS


def test_each_documented_range_expands_as_documented() -> None:
    rows = re.findall(r"^\| `([^`]*\[[^`]*)` \| (.*) \|$", _TEXT, re.MULTILINE)
    assert len(rows) == 4
    for pattern, made in rows:
        assert ", ".join(f"`{name}`" for name in expand(pattern)) == made


def test_every_section_and_node_state_is_documented() -> None:
    for name in (*InventoryDocument.model_fields, *(state.value for state in NodeState)):
        assert f"`{name}`" in _TEXT, name


def test_the_documented_limits_match_the_code() -> None:
    limits = (
        f"{source.MAX_FILE_BYTES // 2**20} MiB a file, {include.MAX_FILES} files, {MAX_VALUES:,} values",
        f"{MAX_DEPTH} levels, {MAX_NAMES:,} nodes, {MAX_DIAGNOSTICS:,} reported errors",
    )
    flat = " ".join(_TEXT.split())
    assert all(limit in flat for limit in limits)


def test_the_nodes_of_the_example_load(tmp_path: Path) -> None:
    loaded = load_text(tmp_path, HEAD + _examples()[0])
    assert loaded.fleet is not None, loaded.diagnostics
    assert loaded.fleet.nodes["husky1-b03"].state is NodeState.LOST


def test_the_robots_of_the_examples_load_with_their_lans_and_computers(tmp_path: Path) -> None:
    lans, computers, links = (text for text in _examples() if text.startswith("robots:"))
    fleet = load_text(tmp_path, HEAD + lans).fleet
    assert fleet is not None
    assert [str(robot.lan) for robot in fleet.robots.values()] == ["10.43.1.0/24", "10.43.2.0/24"]
    fleet = load_text(tmp_path, HEAD + computers).fleet
    assert fleet is not None
    assert list(fleet.robots["husky1"].computers) == ["jetson", "lidar"]
    fleet = load_text(tmp_path, HEAD + links).fleet
    assert fleet is not None
    computer = fleet.robots["husky1"].computer
    assert computer is not None
    assert len(computer.links) == 2


def test_the_relays_of_the_example_load(tmp_path: Path) -> None:
    (relays,) = (text for text in _examples() if text.startswith("udp_mesh:") and "relay" in text)
    fleet = load_text(tmp_path, HEAD + relays).fleet
    assert fleet is not None
    assert {robot.name: robot.relay for robot in fleet.robots.values()} == {"husky1": ("uav1",), "uav1": ()}
    assert fleet.udp_mesh.relay_hops == 3


@pytest.mark.parametrize("number", range(3))
def test_each_documented_secret_reference_loads(number: int, tmp_path: Path) -> None:
    (example,) = (text for text in _examples() if text.startswith("key: "))
    reference = example.splitlines()[number].partition(": ")[2]
    loaded = load_text(tmp_path, f"{HEAD}udp_mesh:\n  keys:\n  - {reference}\n")
    assert loaded.fleet is not None, loaded.diagnostics


def test_the_thin_links_of_the_example_load(tmp_path: Path) -> None:
    (thin,) = (text for text in _examples() if text.startswith("udp_mesh:") and "thin_links" in text)
    fleet = load_text(tmp_path, HEAD + thin).fleet
    assert fleet is not None
    assert fleet.udp_mesh.thin_links["lora"].allowed_duty_cycle == 0.01
    numbers = {robot.name: robot.thin.number for robot in fleet.robots.values() if robot.thin is not None}
    assert numbers == {"base-station": 1, "husky1": 2}
    assert [topic.name for topic in fleet.topics if topic.thin] == ["estop"]
