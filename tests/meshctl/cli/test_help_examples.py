"""The examples in the help are commands that can be copied, from a narrow terminal, too."""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from typing import Any

import pytest
import typer

from meshctl.cli import main as root
from meshctl.cli.commands import COMMANDS


def _leaves(command: Any) -> Iterator[Any]:
    inner = getattr(command, "commands", None)
    if inner is None:
        yield command
    else:
        for below in inner.values():
            yield from _leaves(below)


def _as_typed(lines: Iterator[str]) -> str:
    """The command that a shell reads from these lines, to the first one that does not continue."""
    words: list[str] = []
    for line in lines:
        words += line.removesuffix("\\").split()
        if not line.endswith("\\"):
            break
    return " ".join(words)


@pytest.mark.parametrize("width", [50, 78])
@pytest.mark.parametrize("name", [name for name in COMMANDS if name != "help"])
def test_an_example_is_one_command_at_any_width(name: str, width: int) -> None:
    """`node-exporter` was broken at its hyphen, and a second line was a command of its own."""
    group: Any = typer.main.get_command(root.build(name))
    for command in _leaves(group.commands[name]):
        written = inspect.cleandoc(command.help).split("\n\nExample: ")[1:]
        context = typer.Context(command, info_name=name, max_content_width=width, terminal_width=width)
        shown = command.get_help(context).splitlines()
        starts = [number for number, line in enumerate(shown) if line.startswith("  Example: ")]
        assert written
        assert [_as_typed(iter(shown[start:])).removeprefix("Example: ") for start in starts] == [
            " ".join(example.split()) for example in written
        ]
