"""Edits of an inventory whose nodes are in several files go to the file where they belong, and say which one it is."""

from __future__ import annotations

from pathlib import Path
from textwrap import dedent

import pytest
from typer.testing import CliRunner, Result

from meshctl.cli.main import build
from meshctl.inventory.edit import Editor, save, set_state
from meshctl.model import NodeState
from tests.meshctl.interchange.devices import SSH_KEY
from tests.meshctl.inventory.inventories import HEAD

TABLE = "node,mac,address\nn1,02:00:5e:00:00:04,\nn2,02:00:5e:00:00:05,10.42.0.202\n"


@pytest.fixture
def inventory(tmp_path: Path) -> Path:
    own = "include: [north.yaml]\nnodes:\n  base: {hardware: rocket, role: base, address: 10.42.0.1}\n"
    (tmp_path / "fleet.yaml").write_text(dedent(HEAD) + own, encoding="utf-8")
    north = """\
        nodes:
          b[01-03]: {hardware: rocket, address: {from: 10.42.0.101}}
          n1: {hardware: rocket, address: 10.42.0.201}
        """
    (tmp_path / "north.yaml").write_text(dedent(north), encoding="utf-8")
    return tmp_path


def _import(inventory: Path, *options: str) -> Result:
    words = ["inventory", "import", "csv", "-", "-i", str(inventory), *options]
    return CliRunner().invoke(
        build("inventory"),
        words,
        input=TABLE.replace("\n", ",rocket\n").replace("address,rocket", "address,hardware", 1),
    )


def test_new_nodes_of_a_table_need_a_file_where_several_have_nodes(inventory: Path) -> None:
    texts = {file: file.read_text() for file in inventory.glob("*.yaml")}
    refused = _import(inventory, "--add")
    assert refused.exit_code != 0
    assert "2 files of the inventory have nodes: " in refused.output
    assert "hint: say which one gets the new nodes: --file" in refused.output
    assert "expected a file of the inventory" in _import(inventory, "--add", "--file", "other.yaml").output
    assert {file: file.read_text() for file in texts} == texts
    # as in `include`; also as the shell sees it
    done = _import(inventory, "--add", "--file", "north.yaml")
    assert done.exit_code == 0, done.output
    assert f"1 to add in {inventory / 'north.yaml'}" in done.output
    assert "n2:" in (inventory / "north.yaml").read_text()
    assert (inventory / "fleet.yaml").read_text() == texts[inventory / "fleet.yaml"]


def test_a_node_of_a_range_gets_its_own_entry_in_the_file_of_the_range(inventory: Path) -> None:
    editor = Editor.open(inventory)
    set_state(editor, "b02", NodeState.LOST)
    save(editor.changes())
    lines = (inventory / "north.yaml").read_text().splitlines()
    assert lines[2] == "  b02: {state: lost}"


def test_an_existing_device_goes_to_the_file_that_the_operator_names(inventory: Path) -> None:
    fleet = inventory / "fleet.yaml"
    fleet.write_text(fleet.read_text() + f"operators: {{ssh_keys: ['{SSH_KEY}']}}\n", encoding="utf-8")
    export = Path(__file__).parents[1] / "interchange" / "exports" / "foreign.uci"
    texts = {file: file.read_text() for file in inventory.glob("*.yaml")}
    words = ["inventory", "import", "uci", str(export), "-i", str(inventory), "--hardware", "rocket"]
    words += ["--address", "10.42.0.220/24", "--name", "roof"]
    refused = CliRunner().invoke(build("inventory"), words)
    assert refused.exit_code != 0
    assert "2 files of the inventory have nodes: " in refused.output
    both = CliRunner().invoke(build("inventory"), [*words, "--file", "x.yaml", "--new", str(inventory / "new")])
    assert "use one of them" in both.output
    assert {file: file.read_text() for file in texts} == texts
    done = CliRunner().invoke(build("inventory"), [*words, "--file", str(inventory / "north.yaml")])
    assert "roof:" in (inventory / "north.yaml").read_text(), done.output
    assert "roof:" not in (inventory / "fleet.yaml").read_text()
