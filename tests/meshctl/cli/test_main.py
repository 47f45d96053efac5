"""The root command: help names every command, errors become a message and an exit code, completion works."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from itertools import groupby
from pathlib import Path
from typing import Any

import pytest
import typer

from meshctl import __version__
from meshctl.cli import main as root
from meshctl.cli.commands import COMMANDS
from meshctl.errors import InputError
from meshctl.inventory.starter import write_starter
from meshctl.resources import shipped


def run(*arguments: str, **environ: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "meshctl", *arguments],
        capture_output=True,
        text=True,
        env={**os.environ, **environ},
        check=False,
    )


def test_help_lists_every_command_under_its_heading() -> None:
    lines = run("--help").stdout.splitlines()
    for heading, entries in groupby(COMMANDS.items(), lambda item: item[1].heading):
        at = lines.index(f"{heading}:") + 1
        commands = [(name, entry.summary) for name, entry in entries]
        assert [tuple(line.split(maxsplit=1)) for line in lines[at : at + len(commands)]] == commands


@pytest.mark.parametrize("words", [["lab"], ["robots", "topic"]], ids=" ".join)
def test_group_help_does_not_truncate_command_summaries(words: list[str]) -> None:
    shown = run(*words, "--help", COLUMNS="60").stdout
    assert "Commands:" in shown
    assert "..." not in shown.split("Commands:")[1]
    assert max(map(len, shown.splitlines())) <= 60


def test_version_is_the_packages_version() -> None:
    done = run("--version")
    assert (done.returncode, done.stdout.strip()) == (0, f"meshctl {__version__}")


def test_an_unknown_command_is_a_usage_error_with_a_suggestion() -> None:
    done = run("lnit")
    assert done.returncode == 2
    assert "lnit" in done.stderr
    assert "lint" in done.stderr


def test_options_before_the_command_are_answered_with_the_right_order() -> None:
    done = run("-v", "run", "b01", "--", "uptime")
    expected = "error: options follow the command\nhint: meshctl run b01 -v -- uptime\n"
    assert (done.returncode, done.stderr) == (2, expected)
    # a group has no such option, its commands have
    assert run("-i", "x", "inventory", "list").stderr.endswith("hint: meshctl inventory list -i x\n")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("history", "--limit", "x"), "Invalid value for '--limit' / '-n': expected a whole number, found 'x'"),
        (("history", "--limit", "0"), "expected a value greater than or equal to 1, found '0'"),
        (("status", "--watch", "often"), "expected a number, found 'often'"),
        (("inventory", "state", "b01", "gone"), "Invalid value for 'new': 'gone' is not one of 'carried', 'deployed'"),
    ],
    ids=" ".join,
)
def test_a_wrong_value_is_explained_in_plain_words(words: tuple[str, ...], message: str) -> None:
    assert message in " ".join(run(*words).stderr.split())


@pytest.mark.parametrize("name", list(COMMANDS))
def test_each_command_has_help_with_an_example(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Groups show their commands; a command's own help holds one line that starts with the program's name."""
    with pytest.raises(SystemExit) as ended:
        root.main([name, "--help"])
    shown = capsys.readouterr().out
    assert ended.value.code == 0
    assert not [line for line in shown.splitlines() if line.count("Example: ") > 1], "one example a line"
    assert COMMANDS[name].attribute == "app" or f"meshctl {name}" in shown.split("Usage:", 1)[1].split("\n", 1)[1]


def test_help_names_values_in_words_and_gives_each_example_its_own_line() -> None:
    wrong = []
    for name in COMMANDS:
        group: Any = typer.main.get_command(root.build(name))
        for words, command in _leaves(group.commands[name], (name,)):
            shown = command.get_help(typer.Context(command, info_name=words))
            kinds = [line.strip() for line in shown.splitlines() if re.search(r"<(list|str|int|float|path)", line)]
            wrong += [f"{words}: {line}" for line in kinds]
            paragraphs = [" ".join(paragraph.split()) for paragraph in shown.split("\n\n")]
            wrong += [f"{words}: {text}" for text in paragraphs if text.count("Example: ") > 1]
    assert wrong == []


# these read no inventory: they make one, describe its format, show journal or help, or act on a running virtual fleet
_IN_THE_LAB = "down status shell break mend plug unplug image link move ground mission sweep"
WITHOUT_INVENTORY = {
    "worker",
    "init",
    "schema",
    "history",
    "help",
    "plan-placement",
    *(f"lab {name}" for name in _IN_THE_LAB.split()),
}


def _leaves(command: Any, words: tuple[str, ...]) -> Iterator[tuple[str, Any]]:
    inner_commands = getattr(command, "commands", None)
    if inner_commands is not None:
        for name, inner in inner_commands.items():
            yield from _leaves(inner, (*words, name))
    else:
        yield " ".join(words), command


def _options() -> dict[str, set[str]]:
    options: dict[str, set[str]] = {}
    for name in COMMANDS:
        group: Any = typer.main.get_command(root.build(name))
        for words, command in _leaves(group.commands[name], (name,)):
            options[words] = {option for parameter in command.params for option in parameter.opts}
    return options


def test_every_command_that_reads_an_inventory_takes_it_as_an_option() -> None:
    lacking = {words for words, found in _options().items() if not {"--inventory", "-i"} <= found}
    assert lacking == WITHOUT_INVENTORY


def test_every_command_that_asks_before_a_change_has_a_dry_run() -> None:
    # preflight asks before it sends an emergency stop, and changes nothing
    assert {words for words, found in _options().items() if "--yes" in found and "--dry-run" not in found} == {
        "preflight"
    }


def test_completion_offers_the_commands(tmp_path: Path) -> None:
    done = run(_MESHCTL_COMPLETE="complete_bash", COMP_WORDS="meshctl li", COMP_CWORD="1")
    assert "lint" in done.stdout


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("meshctl status -i FLEET rover1-b0", [f"rover1-b0{number}" for number in range(1, 7)]),
        ("meshctl inventory state -i FLEET ba", ["base"]),
        ("meshctl plan -i FLEET base,rover1-r", ["base,rover1-radio"]),
        ("meshctl provision -i FLEET --limit !ba", ["!base"]),
        ("meshctl status -i /nowhere b", []),
    ],
)
def test_completion_offers_the_nodes_of_the_inventory(words: str, expected: list[str]) -> None:
    typed = words.replace("FLEET", str(shipped("inventory") / "starter"))
    number = str(len(typed.split()) - 1)
    done = run(_MESHCTL_COMPLETE="complete_bash", COMP_WORDS=typed, COMP_CWORD=number)
    assert (done.stdout.split(), done.stderr) == (expected, "")


def test_an_error_is_one_message_with_its_hint_and_exit_code(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fails() -> None:
        raise InputError("fleet.yaml:3:1: expected a mapping, found a list", hint="see `meshctl init`")

    monkeypatch.setattr("meshctl.cli.lint.lint", fails)
    with pytest.raises(SystemExit) as end:
        root.main(["lint"])
    assert end.value.code == 2
    assert capsys.readouterr().err == (
        "error: fleet.yaml:3:1: expected a mapping, found a list\nhint: see `meshctl init`\n"
    )


def test_ctrl_c_ends_with_130(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def interrupted() -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("meshctl.cli.lint.lint", interrupted)
    with pytest.raises(SystemExit) as end:
        root.main(["lint"])
    assert end.value.code == 130


def test_a_closed_output_pipe_is_not_a_failure() -> None:
    with subprocess.Popen(
        [sys.executable, "-m", "meshctl", "lint", "--list"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        process.stdout.close()
        assert process.stderr is not None
        assert (process.stderr.read(), process.wait()) == ("", 0)


def test_ctrl_c_before_the_command_starts_is_reported_as_interrupted(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(meant: str) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(root, "build", interrupted)
    with pytest.raises(SystemExit) as ended:
        root.main(["plan"])
    assert (ended.value.code, capsys.readouterr().err) == (130, "interrupted\n")


@pytest.mark.parametrize("words", [("--help",), ("lint", "--list"), ("schema",)], ids=" ".join)
def test_a_full_disk_behind_the_output_is_an_error_without_a_traceback(words: tuple[str, ...]) -> None:
    with open("/dev/full", "w", encoding="utf-8") as full:
        done = subprocess.run(
            [sys.executable, "-m", "meshctl", *words], stdout=full, stderr=subprocess.PIPE, text=True, check=False
        )
    assert (done.returncode, done.stderr) == (2, "error: cannot write the output: No space left on device\n")


def test_closed_streams_are_not_taken_over_by_files(tmp_path: Path) -> None:
    write_starter(tmp_path)
    # rich asks whether standard output is a terminal; the log would be the next file with its number
    command = f"exec <&- >&-; {sys.executable} -m meshctl inventory list -i {tmp_path} --log-file {tmp_path}/log"
    done = subprocess.run(["sh", "-c", command], stderr=subprocess.PIPE, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert "base" not in (tmp_path / "log").read_text()
