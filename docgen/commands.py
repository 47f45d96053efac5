"""Command line definitions (typer, argparse) -> one tree of `Command`, the same for both programs."""

from __future__ import annotations

import argparse
import importlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from pathlib import Path
from typing import Any, NoReturn
from unittest import mock


@dataclass(frozen=True, slots=True)
class Option:
    """An option, or an argument when `names` is empty."""

    names: tuple[str, ...]
    metavar: str
    """Empty for flags."""
    help: str
    default: str = ""
    variable: str = ""
    """The environment variable that stands in for it."""

    @property
    def synopsis(self) -> str:
        return f"{', '.join(self.names)} {self.metavar}".strip()


@dataclass(frozen=True, slots=True)
class Command:
    """A command; `name` is what is typed, such as `meshctl robots deploy`."""

    name: str
    summary: str
    """One line."""
    description: tuple[str, ...]
    """Paragraphs."""
    examples: tuple[str, ...]
    arguments: tuple[Option, ...]
    options: tuple[Option, ...]
    commands: tuple[Command, ...]
    notes: tuple[str, ...] = ()
    """Paragraphs that follow the options, such as the exit codes."""

    @property
    def usage(self) -> str:
        if self.commands:
            return f"{self.name} COMMAND ..."
        words = [self.name, *(["[OPTIONS]"] if self.options else []), *(each.metavar for each in self.arguments)]
        return " ".join(words)

    def walk(self) -> Iterable[Command]:
        """This command and all below it."""
        yield self
        for command in self.commands:
            yield from command.walk()


def programs() -> tuple[Command, ...]:
    """Both programs."""
    return meshctl(), udp_mesh()


def meshctl() -> Command:
    """The commands that typer builds, extensions included."""
    from typer.main import get_command

    from meshctl.cli.commands import COMMANDS
    from meshctl.cli.main import build

    root = get_command(build(""))
    commands = []
    for name, entry in COMMANDS.items():
        if entry.module:
            # only the command that is named is imported for real
            found = vars(get_command(build(name)))["commands"][name]
        else:
            # an extension's entry point exists in an installed distribution only, and this also runs while one is built
            found = get_command(importlib.import_module("meshlab.cli.commands").app)
        commands.append(_from_typer(found, f"meshctl {name}", entry.summary))
    return _from_typer(root, "meshctl", "", commands)


def _from_typer(command: Any, name: str, summary: str, commands: Sequence[Command] | None = None) -> Command:
    paragraphs, examples = _paragraphs(command.help or "")
    notes, more = _paragraphs(command.epilog or "")
    inner = getattr(command, "commands", {})
    if commands is None:
        commands = [_from_typer(found, f"{name} {word}", "") for word, found in sorted(inner.items())]
    hidden = {"install_completion", "show_completion", "help"}
    parameters = [each for each in command.params if each.name not in hidden and not getattr(each, "hidden", False)]
    is_argument = {each.name: not each.opts[0].startswith("-") for each in parameters}
    return Command(
        name,
        summary or (paragraphs[0] if paragraphs else ""),
        tuple(paragraphs or [summary]),
        (*examples, *more),
        tuple(_typer_argument(each) for each in parameters if is_argument[each.name]),
        tuple(_typer_option(each) for each in parameters if not is_argument[each.name]),
        tuple(commands),
        tuple(notes),
    )


def _typer_argument(parameter: Any) -> Option:
    word = parameter.metavar or parameter.name.upper()
    word = f"[{word}]" if not parameter.required else word
    return Option((), f"{word}..." if parameter.nargs != 1 else word, _one_line(parameter.help))


def _typer_option(parameter: Any) -> Option:
    names = (*sorted(parameter.opts, key=len), *parameter.secondary_opts)
    metavar = "" if parameter.is_flag or parameter.count else parameter.metavar or parameter.name.upper()
    default = parameter.default
    shown = default is not None and not callable(default) and default not in (False, "", [], ()) and parameter.is_flag
    if metavar and default not in (None, "", [], ()) and not callable(default):
        shown = True
    text = str(default.value if isinstance(default, Enum) else default) if shown and default is not True else ""
    return Option(names, metavar, _one_line(parameter.help), text, parameter.envvar or "")


def udp_mesh() -> Command:
    """The commands that argparse builds; `report` and `sim` have parsers of their own."""
    from udp_mesh.cli.main import FORWARDED, build_parser
    from udp_mesh.sim.sweep import parser as sweep_parser

    own = {name: _parser_of(package) for name, package in FORWARDED.items()}
    root = _from_argparse(build_parser(), "udp-mesh", "", own)
    # beside `udp-mesh sim`, which has options of its own
    sweep = _from_argparse(sweep_parser(), "udp-mesh sim sweep", "compare settings of a scenario over many seeds", {})
    return replace(root, commands=(*root.commands, sweep))


class _Parsing(Exception):
    def __init__(self, parser: argparse.ArgumentParser) -> None:
        super().__init__()
        self.parser = parser


def _parser_of(package: str) -> argparse.ArgumentParser:
    """The parser that the package's `main` makes for itself."""

    def stop(parser: argparse.ArgumentParser, *_: object) -> NoReturn:
        raise _Parsing(parser)

    with mock.patch.object(argparse.ArgumentParser, "parse_args", stop):
        try:
            importlib.import_module(package).main([])
        except _Parsing as found:
            return found.parser
    raise AssertionError(f"{package}.main parses no arguments")


def _from_argparse(
    parser: argparse.ArgumentParser, name: str, summary: str, own: dict[str, argparse.ArgumentParser]
) -> Command:
    commands: list[Command] = []
    arguments, options = [], []
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            summaries = {each.dest: each.help or "" for each in action._choices_actions}
            commands = [
                _from_argparse(own.get(word) or inner, f"{name} {word}", summaries.get(word) or "", own)
                for word, inner in action.choices.items()
            ]
        elif action.dest == "help" or action.help == argparse.SUPPRESS:
            continue
        elif action.option_strings:
            options.append(_argparse_option(action, parser))
        else:
            arguments.append(_argparse_argument(action, parser))
    notes, examples = _paragraphs(parser.epilog or "")
    description = parser.description or summary
    return Command(
        name,
        _sentence(summary or description),
        (description,),
        tuple(examples),
        tuple(arguments),
        tuple(options),
        tuple(commands),
        tuple(notes),
    )


def _argparse_option(action: argparse.Action, parser: argparse.ArgumentParser) -> Option:
    metavar = "" if action.nargs == 0 else _metavar(action)
    if action.nargs == argparse.OPTIONAL:
        metavar = f"[{metavar}]"
    return Option(tuple(sorted(action.option_strings, key=len)), metavar, _expanded(action, parser))


def _argparse_argument(action: argparse.Action, parser: argparse.ArgumentParser) -> Option:
    word = str(action.metavar or action.dest.upper())
    if action.nargs in (argparse.OPTIONAL, argparse.ZERO_OR_MORE):
        word = f"[{word}]"
    if action.nargs in (argparse.ONE_OR_MORE, argparse.ZERO_OR_MORE):
        word += "..."
    return Option((), word, _expanded(action, parser))


def _metavar(action: argparse.Action) -> str:
    if action.choices is not None:
        return "|".join(map(str, action.choices))
    return str(action.metavar or action.dest.upper())


def _expanded(action: argparse.Action, parser: argparse.ArgumentParser) -> str:
    values = {**vars(action), "prog": parser.prog}
    if isinstance(values["default"], Path):
        values["default"] = str(values["default"])
    return _one_line((action.help or "") % values)


def _one_line(text: str | None) -> str:
    return " ".join((text or "").split())


def _sentence(text: str) -> str:
    line = _one_line(text)
    return line[:1].upper() + line[1:]


def _paragraphs(text: str) -> tuple[list[str], list[str]]:
    """Paragraphs of prose, and the command lines of the examples."""
    prose: list[str] = []
    examples: list[str] = []
    for part in text.strip().split("\n\n"):
        head, colon, rest = part.strip().partition(":")
        if colon and head.strip().lower() in ("example", "examples"):
            examples += [line.strip() for line in rest.strip().splitlines() if line.strip()]
        elif part.strip():
            prose.append(_sentence(part))
    return prose, examples
