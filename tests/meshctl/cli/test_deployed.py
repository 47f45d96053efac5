"""`meshctl deployed`: a dropped beacon is required to answer from then on."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from meshctl.cli.main import build
from meshctl.inventory import load_fleet
from meshctl.inventory.starter import write_starter
from meshctl.model import NodeState

_BOXES = """
  husky1-b[1-3]: {groups: [beacons], address: {from: 10.42.0.201}}   # in husky1's rack
  husky1-b2: {label: B2}  # the one with the bent antenna
"""


@pytest.fixture
def inventory(tmp_path: Path) -> Path:
    write_starter(tmp_path)
    file = tmp_path / "fleet.yaml"
    file.write_text(file.read_text().replace("\n# The peers of udp_mesh", f"{_BOXES}\n# The peers of udp_mesh", 1))
    return tmp_path


def _run(inventory: Path, *words: str) -> Result:
    return CliRunner().invoke(build("deployed"), ["deployed", *words, "-i", str(inventory)])


def _states(inventory: Path) -> dict[str, NodeState]:
    return {name: node.state for name, node in load_fleet(inventory).nodes.items()}


def test_a_beacon_is_marked_as_deployed_without_other_edits(inventory: Path) -> None:
    before = (inventory / "fleet.yaml").read_text().splitlines()
    result = _run(inventory, "husky1-b3")
    assert result.exit_code == 0, result.output
    after = (inventory / "fleet.yaml").read_text().splitlines()
    assert [line for line in after if line not in before] == ["  husky1-b3: {state: deployed}"]
    assert [line for line in before if line not in after] == []
    assert "+  husky1-b3: {state: deployed}" in result.output
    assert _states(inventory)["husky1-b3"] is NodeState.DEPLOYED


def test_labels_match_beacons_case_insensitively(inventory: Path) -> None:
    assert _run(inventory, "b2").exit_code == 0
    assert _states(inventory)["husky1-b2"] is NodeState.DEPLOYED
    assert "the one with the bent antenna" in (inventory / "fleet.yaml").read_text()


def test_several_beacons_and_patterns_are_one_edit(inventory: Path) -> None:
    assert _run(inventory, "husky1-b*", "B2", "rover1-b01").exit_code == 0
    marked = {name for name, state in _states(inventory).items() if state is NodeState.DEPLOYED}
    assert {"husky1-b1", "husky1-b2", "husky1-b3", "rover1-b01"} <= marked
    assert "rover1-b02" not in marked


def test_an_already_deployed_beacon_is_reported_and_left_unchanged(inventory: Path) -> None:
    _run(inventory, "husky1-b1")
    text = (inventory / "fleet.yaml").read_text()
    result = _run(inventory, "husky1-b1")
    assert (result.exit_code, result.output) == (0, "husky1-b1: already deployed\n")
    assert (inventory / "fleet.yaml").read_text() == text


def test_back_marks_a_beacon_as_carried_again(inventory: Path) -> None:
    _run(inventory, "husky1-b1", "husky1-b2")
    assert _run(inventory, "husky1-b1", "--back").exit_code == 0
    states = _states(inventory)
    assert (states["husky1-b1"], states["husky1-b2"]) == (NodeState.CARRIED, NodeState.DEPLOYED)


def test_a_dry_run_shows_the_edit_and_writes_nothing(inventory: Path) -> None:
    text = (inventory / "fleet.yaml").read_text()
    assert "state: deployed" in _run(inventory, "husky1-b3", "--dry-run").output
    assert (inventory / "fleet.yaml").read_text() == text


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("husky1-b9",), "no beacon matches 'husky1-b9'"),
        (("base",), "base is not a beacon: its role is base"),
        (("base",), "hint: for any node: meshctl inventory state base deployed"),
        (("x*",), "no beacon matches 'x*'"),
    ],
)
def test_a_node_that_is_not_a_beacon_is_rejected_and_nothing_is_written(
    words: tuple[str, ...], message: str, inventory: Path
) -> None:
    text = (inventory / "fleet.yaml").read_text()
    result = _run(inventory, "husky1-b1", *words)
    assert result.exit_code == 2
    assert message in result.stderr
    assert (inventory / "fleet.yaml").read_text() == text


def test_a_lost_beacon_is_not_implicitly_marked_as_deployed(inventory: Path) -> None:
    file = inventory / "fleet.yaml"
    file.write_text(file.read_text().replace("{label: B2}", "{label: B2, state: lost}"))
    result = _run(inventory, "husky1-b2")
    assert result.exit_code == 2
    assert "expected carried beacons, found: husky1-b2 is lost" in result.stderr
    assert "meshctl inventory state husky1-b2 deployed" in result.stderr


def test_missing_or_conflicting_arguments_are_usage_errors(inventory: Path) -> None:
    result = _run(inventory)
    assert (result.exit_code, "expected beacons, or --from-mesh" in result.stderr) == (2, True)
    both = _run(inventory, "--from-mesh", "--back")
    assert (both.exit_code, "expected --back or --from-mesh, found both" in both.stderr) == (2, True)
