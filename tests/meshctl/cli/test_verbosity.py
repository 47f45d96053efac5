"""`--verbose` and `--log-file`: what is recorded, and what is not."""

from __future__ import annotations

import io
import json
import stat
from pathlib import Path
from typing import Annotated, Any

import pytest
import typer
from typer.testing import CliRunner

from meshctl import event_log
from meshctl.cli.verbosity import with_verbosity
from meshctl.errors import InputError
from meshctl.inventory.secrets import SecretStore
from meshctl.model import SecretKind, SecretRef

KEY = "correct horse battery"


def invoked(*words: str) -> Any:
    def command(node: Annotated[str, typer.Argument()]) -> None:
        secret = SecretStore({"MESH_KEY": KEY}).get(SecretRef(SecretKind.ENV, "MESH_KEY"))
        event_log.emit(event_log.INFO, "connected", device=node)
        event_log.emit(event_log.DEBUG, "command", device=node, script=f"uci set key={secret.reveal()}\x1b[2J")
        event_log.emit(event_log.INFO, "step", node=node, text="stage")
        if node == "b99":
            raise InputError("no such node")

    app = typer.Typer()
    app.command()(with_verbosity(command))
    return CliRunner().invoke(app, list(words))


def test_nothing_is_shown_without_the_options() -> None:
    assert invoked("b03").output == ""


def test_one_v_shows_connections_and_two_show_commands() -> None:
    once, twice = invoked("b03", "-v").stderr, invoked("b03", "-vv").stderr
    assert "connected: device=b03" in once
    assert "uci" not in once
    assert "uci set key=***" in twice
    # the progress of a run shows its steps
    assert "stage" not in twice
    assert "\x1b" not in twice
    assert "exit_code=0" in once


def test_the_file_has_every_event_as_json_without_secrets(tmp_path: Path) -> None:
    file = tmp_path / "logs/meshctl.log"
    assert invoked("b03", "--log-file", str(file)).output == ""
    invoked("b99", "--log-file", str(file))
    text = file.read_text()
    assert KEY not in text
    events = [json.loads(line) for line in text.splitlines()]
    assert [each["event"] for each in events] == ["began", "connected", "command", "step", "ended"] * 2
    assert events[2]["script"] == f"uci set key={event_log.MASK}\x1b[2J"
    assert (events[4]["exit_code"], events[9]["exit_code"], events[9]["error"]) == (0, 2, "no such node")
    assert stat.S_IMODE(file.stat().st_mode) == 0o600


def test_a_file_that_cannot_be_written_is_an_error(tmp_path: Path) -> None:
    result = invoked("b03", "--log-file", str(tmp_path))
    assert isinstance(result.exception, InputError)
    assert "cannot write the log file" in str(result.exception)


def test_every_line_of_a_hidden_value_is_masked_except_short_ones() -> None:
    event_log.hide("-----BEGIN KEY-----\nb64b64b64\nab\n")
    assert event_log.masked("x b64b64b64 ab") == f"x {event_log.MASK} ab"


def test_a_long_script_is_shortened() -> None:
    out = io.StringIO()
    handler = event_log.add_handler(out, event_log.DEBUG, event_log.JsonLines())
    try:
        event_log.emit(event_log.DEBUG, "command", script="x" * 5000, error=None)
    finally:
        event_log.remove_handler(handler)
    event = json.loads(out.getvalue())
    assert event["script"].endswith("... (5000 characters)")
    assert "error" not in event


@pytest.mark.parametrize("name", ["status", "provision", "history"])
def test_every_command_has_the_options(name: str) -> None:
    from meshctl.cli.main import build

    group: Any = typer.main.get_command(build(name))
    options = {word for each in group.commands[name].params for word in each.opts}
    assert {"-v", "--verbose", "--log-file"} <= options
