"""The user's configuration file: defaults for options, checked with file and line."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import typer

from meshctl.cli import main as root
from meshctl.cli.user_config import load
from meshctl.errors import InputError


def defaults_for(tmp_path: Path, text: str, command: str = "status") -> dict[str, Any]:
    file = tmp_path / "config.toml"
    file.write_text(text)
    group: Any = typer.main.get_command(root.build(command))
    return load(str(file)).for_command(command, group.commands[command])


def test_common_settings_apply_where_the_command_has_the_option(tmp_path: Path) -> None:
    text = 'inventory = "fleet"\nkey = ["id"]\nverbose = 1\n'
    assert defaults_for(tmp_path, text) == {
        "inventory": str(tmp_path / "fleet"),
        "key": [str(tmp_path / "id")],
        "verbose": 1,
    }
    assert defaults_for(tmp_path, text, "history") == {"verbose": 1}


def test_a_table_sets_the_options_of_one_command(tmp_path: Path) -> None:
    text = "[status]\nwide = true\nno-robots = true\ntimeout = 3\n[robots.deploy]\nwait = 60\n"
    assert defaults_for(tmp_path, text) == {"wide": True, "no_robots": True, "timeout": 3}
    assert defaults_for(tmp_path, text, "robots")["deploy"] == {"wait_s": 60}


@pytest.mark.parametrize(
    ("text", "message", "hint"),
    [
        ("parallel = 8\ncolour = 'never'\n", "config.toml:2: colour: unknown setting", "did you mean 'color'"),
        ("color = 'red'\n", "config.toml:1: color: expected one of auto, never, found 'red'", ""),
        ("parallel = 0\n", "config.toml:1: parallel: expected an integer of 1 or more, found 0", ""),
        ("a = 1\nb = = 2\n", "config.toml:2:5: Invalid value", "TOML"),
        ("status = 3\n", "config.toml:1: status: expected a table [status], found 3", ""),
        ("\n[status]\nwid = true\n", "config.toml:3: status.wid: no such option", "did you mean 'wide'"),
        ("[status]\nwide = 'yes'\n", "config.toml:2: status.wide: expected true or false, found 'yes'", ""),
        ("[status]\ntimeout = 'soon'\n", "config.toml:2: status.timeout: ", ""),
        ("[provision]\nyes = true\n", "config.toml:2: provision.yes: cannot be set here", ""),
        ("[robots.depoy]\nwait = 60\n", "config.toml:1: robots.depoy: `meshctl robots` has no command", "deploy"),
    ],
)
def test_a_bad_file_is_reported_with_its_line(tmp_path: Path, text: str, message: str, hint: str) -> None:
    names = ("robots",) if "robots" in text else ("provision",) if "provision" in text else ("status",)
    with pytest.raises(InputError) as caught:
        defaults_for(tmp_path, text, *names)
    assert message in str(caught.value)
    assert hint in caught.value.hint


def test_the_config_file_is_located_by_xdg_and_can_be_overridden_or_disabled(tmp_path: Path) -> None:
    file = tmp_path / "meshctl/config.toml"
    file.parent.mkdir()
    file.write_text('color = "never"\nparallel = 3\n')
    environ = {"XDG_CONFIG_HOME": str(tmp_path)}
    assert root.user_defaults(environ) is not None
    assert (environ["NO_COLOR"], environ["MESHCTL_PARALLEL"]) == ("1", "3")
    assert root.user_defaults({"XDG_CONFIG_HOME": str(tmp_path), "MESHCTL_CONFIG": ""}) is None
    assert root.user_defaults({"XDG_CONFIG_HOME": str(tmp_path / "none")}) is None
    with pytest.raises(InputError, match="cannot read the configuration"):
        root.user_defaults({"MESHCTL_CONFIG": str(tmp_path / "none.toml")})
    # a variable of the environment takes precedence
    environ = {"XDG_CONFIG_HOME": str(tmp_path), "MESHCTL_PARALLEL": "20"}
    root.user_defaults(environ)
    assert environ["MESHCTL_PARALLEL"] == "20"


def test_the_command_line_takes_precedence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "config.toml").write_text('inventory = "a.yaml"\n[lint]\nformat = "json"\n')
    monkeypatch.setenv("MESHCTL_CONFIG", str(tmp_path / "config.toml"))
    monkeypatch.delenv("MESHCTL_INVENTORY", raising=False)
    for words, named in ((["inventory", "list"], "a.yaml"), (["inventory", "list", "-i", "b.yaml"], "b.yaml")):
        with pytest.raises(SystemExit):
            root.main(words)
        assert named in capsys.readouterr().err
