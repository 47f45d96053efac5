"""`meshctl robots topic set KEY=VALUE`: values, and the inventory if the command is refused."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from meshctl.cli.robots_context import open_robots_context
from meshctl.cli.robots_topics import _change_topics, _fields
from meshctl.errors import InputError
from meshctl.inventory.edit import Editor, set_topic

STARTER = Path(__file__).resolve().parents[3] / "inventory/starter"


@pytest.mark.parametrize("text", ["[" * 5_000, "2026-99-99", "[a", "{a: 1}", "!!python/name:os.system"])
def test_a_value_that_is_no_yaml_value_is_an_error_that_names_its_key(text: str) -> None:
    with pytest.raises(InputError, match=r"priority: expected a "):
        _fields([f"priority={text}"])


def _edit(editor: Editor) -> None:
    set_topic(editor, "telemetry", {"priority": 4})


def test_an_edit_is_reverted_if_the_command_is_refused_before_its_first_robot(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """The inventory had the new topic, and the command ended with the exit code of one that could not run."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.setenv("UDP_MESH_KEY", "5a" * 16 + "c3" * 16)
    monkeypatch.delenv("MESHCTL_LAB", raising=False)
    inventory = Path(shutil.copytree(STARTER, tmp_path / "fleet"))
    before = (inventory / "fleet.yaml").read_bytes()
    with open_robots_context(inventory) as context:
        practicing = replace(context, connector=replace(context.connector, lab="/lab"))
        with pytest.raises(InputError, match="no computers to log in to"):
            _change_topics(practicing, "telemetry", _edit, dry_run=False)
    assert (inventory / "fleet.yaml").read_bytes() == before
    assert "the inventory edit was reverted" in capfd.readouterr().err
