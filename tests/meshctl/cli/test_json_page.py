"""docs/json.md has every command with `--json`, and every key of the documents that need no device."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

from meshctl.cli.commands import COMMANDS
from meshctl.cli.main import build
from meshctl.resources import shipped

_ROOT = Path(__file__).resolve().parents[3]
_PAGE = (_ROOT / "docs/json.md").read_text(encoding="utf-8")


# of the table, below `values`
_COLUMNS = ("label",)


def _commands_with_json(name: str, command: Any) -> Iterator[str]:
    for inner, member in getattr(command, "commands", {}).items():
        yield from _commands_with_json(f"{name} {inner}", member)
    if any("--json" in parameter.opts for parameter in command.params):
        yield name


@pytest.mark.parametrize("requested", sorted(COMMANDS))
def test_every_command_with_json_is_on_the_page(requested: str) -> None:
    root: Any = typer.main.get_command(build(requested))
    for name in _commands_with_json(f"meshctl {requested}", root.commands[requested]):
        # those that change robots have one row
        assert f"`{name}`" in _PAGE or f"`{name} " in _PAGE or name.startswith("meshctl robots "), name


def _keys(value: Any) -> Iterator[str]:
    if isinstance(value, Mapping):
        for key, inner in value.items():
            yield key
            yield from _keys(inner)
    elif isinstance(value, list):
        for inner in value:
            yield from _keys(inner)


@pytest.mark.parametrize(
    ("command", "words"),
    [
        ("inventory list", ()),
        ("inventory show", ("rover1-radio",)),
        ("inventory import csv", ("BOXES", "--dry-run")),
        ("render", ("rover1-radio",)),
        ("diff", ("OTHER",)),
    ],
)
def test_the_keys_of_a_document_are_on_the_page(command: str, words: tuple[str, ...], tmp_path: Path) -> None:
    inventory = Path(shutil.copytree(shipped("inventory") / "starter", tmp_path / "fleet"))
    _edit(inventory, "ssh_keys: []", f"ssh_keys: [ssh-ed25519 {'A' * 68}]")
    other = Path(shutil.copytree(inventory, tmp_path / "other"))
    _edit(other, "channel: 6", "channel: 11")
    (tmp_path / "boxes.csv").write_text("node,label\nrover1-radio,R1\n", encoding="utf-8")
    places = {"OTHER": str(other), "BOXES": str(tmp_path / "boxes.csv")}
    given = [*command.split(), *(places.get(word, word) for word in words), "--inventory", str(inventory), "--json"]
    result = CliRunner().invoke(build(given[0]), given)
    (row,) = (line for line in _PAGE.splitlines() if f"`meshctl {command}`" in line)
    documented = {*re.findall(r"`([a-z_]+)`", row), *_COLUMNS}
    found = set(_keys(json.loads(result.stdout)))
    assert len(found) > 3
    assert found <= documented


def _edit(inventory: Path, old: str, new: str) -> None:
    file = inventory / "fleet.yaml"
    text = file.read_text(encoding="utf-8")
    assert old in text
    file.write_text(text.replace(old, new, 1), encoding="utf-8")
