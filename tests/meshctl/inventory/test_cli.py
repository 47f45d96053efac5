"""`meshctl init`, `schema`, `inventory list|show|state` as a user meets them."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from meshctl.cli.main import build
from meshctl.inventory import load_fleet
from tests.meshctl.inventory.inventories import SHIPPED

_KEY = "ssh-ed25519 AAAAC3NzaC1lZDI1NTE5AAAAIFCutyt+xTdKa5I6TRfbIza4ho4hbhlYM4e+/swgNX9L me@laptop"


def _meshctl(*words: object, home: Path | None = None) -> Result:
    arguments = [str(word) for word in words]
    return CliRunner().invoke(build(arguments[0]), arguments, env={"HOME": str(home or "/nonexistent")})


def test_init_writes_a_starter_that_loads(tmp_path: Path) -> None:
    result = _meshctl("init", tmp_path / "new")
    assert result.exit_code == 0
    assert (tmp_path / "new" / "fleet.yaml").read_bytes() == (SHIPPED / "starter" / "fleet.yaml").read_bytes()
    assert load_fleet(tmp_path / "new").operators.ssh_keys == ()


def test_init_adds_the_operators_public_key(tmp_path: Path) -> None:
    (tmp_path / ".ssh").mkdir()
    (tmp_path / ".ssh" / "id_ed25519.pub").write_text(_KEY + "\n")
    assert _meshctl("init", tmp_path / "a", home=tmp_path).exit_code == 0
    assert load_fleet(tmp_path / "a").operators.ssh_keys == (_KEY,)
    assert "# public keys that may log in" in (tmp_path / "a" / "fleet.yaml").read_text()


def test_init_overwrites_nothing(tmp_path: Path) -> None:
    (tmp_path / "fleet.yaml").write_text("mine\n")
    result = _meshctl("init", tmp_path)
    assert result.exit_code == 2
    assert "already exists; not overwritten" in result.stderr
    assert (tmp_path / "fleet.yaml").read_text() == "mine\n"


@pytest.mark.parametrize("content", ["-----BEGIN OPENSSH PRIVATE KEY-----\n", "hello\n", f"{_KEY}\n{_KEY}\n", ""])
def test_init_rejects_anything_but_a_single_public_key(content: str, tmp_path: Path) -> None:
    (tmp_path / "key").write_text(content)
    result = _meshctl("init", tmp_path / "new", "--ssh-key", tmp_path / "key")
    assert result.exit_code == 2
    assert "is not an SSH public key" in result.stderr
    assert not (tmp_path / "new").exists()


def test_init_in_an_unwritable_place_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    result = _meshctl("init", tmp_path / "file" / "new")
    assert result.exit_code == 2
    assert "cannot be written" in result.stderr


def test_schema_prints_or_writes_json(tmp_path: Path) -> None:
    printed = _meshctl("schema")
    assert json.loads(printed.stdout)["$schema"].endswith("2020-12/schema")
    assert _meshctl("schema", "--out", tmp_path / "s.json").exit_code == 0
    assert (tmp_path / "s.json").read_text() == printed.stdout
    assert _meshctl("schema", "--out", tmp_path / "no" / "s.json").exit_code == 2
    fleet = tmp_path / "fleet.yaml"
    fleet.write_text("name: alpha\n")
    assert _meshctl("schema", "--out", fleet).exit_code == 2
    assert fleet.read_text() == "name: alpha\n"


def test_list_shows_every_node_as_text_and_json() -> None:
    text = _meshctl("inventory", "list", "-i", SHIPPED / "subt-final").stdout.splitlines()
    assert len(text) == 21
    assert text[0].split() == ["NODE", "ROLE", "STATE", "ADDRESS", "HARDWARE", "RELEASE", "MESHES", "ROBOT", "LABEL"]
    data = json.loads(_meshctl("inventory", "list", "-i", SHIPPED / "subt-final", "--json").stdout)
    assert [row["name"] for row in data["nodes"]][:2] == ["base", "husky1-front"]
    assert data["nodes"][0]["meshes"] == ["main"]


def test_list_shows_the_nodes_asked_for() -> None:
    carried = ("inventory", "list", "-i", SHIPPED / "subt-final", "--robot", "husky2", "--state", "carried", "--json")
    names = [row["name"] for row in json.loads(_meshctl(*carried).stdout)["nodes"]]
    assert names == [f"husky2-b{number:02}" for number in range(1, 7)]
    bases = json.loads(_meshctl("inventory", "list", "-i", SHIPPED / "subt-final", "--role", "base", "--json").stdout)
    assert [row["name"] for row in bases["nodes"]] == ["base"]


def test_show_why_names_value_layer_file_and_line() -> None:
    lines = _meshctl("inventory", "show", "husky1-b03", "--why", "-i", SHIPPED / "subt-final").stdout.splitlines()
    power = next(line for line in lines if "tx_power_dbm" in line)
    fleet = load_fleet(SHIPPED / "subt-final")
    line = fleet.where("nodes", "husky1-b03", "radios", "radio0", "tx_power_dbm").position.line
    assert power.split() == [
        "radios.radio0.tx_power_dbm",
        "27",
        "group",
        "beacons",
        f"{SHIPPED / 'subt-final' / 'fleet.yaml'}:{line}",
    ]
    data = json.loads(_meshctl("inventory", "show", "husky1-b03", "--json", "-i", SHIPPED / "subt-final").stdout)
    records = {record["key"]: record for record in data["values"]}
    assert records["address"]["layer"] == "rule"
    assert records["radios.radio0.tx_power_dbm"]["line"] == line


def test_show_of_an_unknown_node_suggests_a_similar_name() -> None:
    result = _meshctl("inventory", "show", "husky1-03", "-i", SHIPPED / "subt-final")
    assert result.exit_code == 2
    assert "did you mean 'husky1-b03'?" in result.stderr


def test_state_prints_its_change_and_writes_it(tmp_path: Path) -> None:
    shutil.copytree(SHIPPED / "subt-final", tmp_path / "f")
    before = (tmp_path / "f" / "fleet.yaml").read_text()
    dry = _meshctl("inventory", "state", "husky1-b03", "deployed", "--dry-run", "-i", tmp_path / "f")
    assert "+  husky1-b03: {state: deployed}" in dry.stdout
    assert (tmp_path / "f" / "fleet.yaml").read_text() == before
    assert _meshctl("inventory", "state", "husky1-b03", "deployed", "-i", tmp_path / "f").stdout == dry.stdout
    assert load_fleet(tmp_path / "f").nodes["husky1-b03"].state.value == "deployed"


def test_a_bad_inventory_is_an_error_with_every_place_and_no_traceback(tmp_path: Path) -> None:
    (tmp_path / "fleet.yaml").write_text("meshctl: 2\nflet: x\n")
    result = _meshctl("inventory", "list", "-i", tmp_path)
    assert result.exit_code == 2
    assert f"{tmp_path / 'fleet.yaml'}:1:10: meshctl: expected 1" in result.stderr
    assert f"{tmp_path / 'fleet.yaml'}:2:1: flet: unknown key 'flet'" in result.stderr
    assert "Traceback" not in result.output
