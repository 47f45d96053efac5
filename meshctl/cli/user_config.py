"""The user's configuration file: defaults for options, `$XDG_CONFIG_HOME/meshctl/config.toml` or `$MESHCTL_CONFIG`.

    inventory = "~/fleets/cave"      # for every command: inventory, key, log_file, verbose, parallel, color
    parallel = 8

    [status]                         # for one command: its long options
    wide = true

    [robots.deploy]
    wheels = "~/wheels"

The command line and environment variables take precedence. `load` reads the file; `Defaults.for_command` checks what it
says about one command and returns click's `default_map` for it.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import typer

from meshctl.cli.commands import COMMANDS
from meshctl.errors import InputError
from meshctl.suggest import did_you_mean

_OPTIONS = ("inventory", "key", "log_file", "verbose")
_COLORS = ("auto", "never")
# each is a decision about one run, which a file must not make in advance
_NEVER = ("yes", "dry_run", "accept_cut", "leave_behind", "replace_key", "change", "help")
_PATHS = ("inventory", "key", "log_file", "lab", "directory", "out", "wheels", "imagebuilder")


@dataclass(frozen=True, slots=True)
class Defaults:
    """The contents of the file; `text` is for the line numbers of errors."""

    path: Path
    text: str
    values: Mapping[str, Any]

    @property
    def environment(self) -> dict[str, str]:
        """The settings that are no options, as environment variables."""
        found: dict[str, str] = {}
        if self.values.get("color") == "never":
            found["NO_COLOR"] = "1"
        if "parallel" in self.values:
            found["MESHCTL_PARALLEL"] = str(self.values["parallel"])
        if "journal" in self.values:
            found["MESHCTL_STORE"] = str(self.values["journal"])
        return found

    def for_command(self, name: str, command: Any) -> dict[str, Any]:
        """The defaults of a command's options, and of those of its commands. Raises InputError with file and line."""
        common = {key: value for key, value in self.values.items() if key in _OPTIONS and not isinstance(value, dict)}
        table = self.values.get(name)
        return self._section_defaults(command, table if isinstance(table, dict) else {}, common, (name,))

    def _section_defaults(
        self, command: Any, table: Mapping[str, Any], common: Mapping[str, Any], names: tuple[str, ...]
    ) -> dict[str, Any]:
        if hasattr(command, "commands"):
            for key in table:
                if key not in command.commands:
                    hint = did_you_mean(key, command.commands)
                    raise self._error(names, key, f"`meshctl {' '.join(names)}` has no command {key!r}", hint)
            return {
                word: self._section_defaults(inner, table.get(word, {}), common, (*names, word))
                for word, inner in command.commands.items()
            }
        options = {each.name: each for each in command.params if each.param_type_name == "option"}
        by_word = {word.lstrip("-").replace("-", "_"): name for name, each in options.items() for word in each.opts}
        found = {
            key: self._checked(command, options[key], value, (), key) for key, value in common.items() if key in options
        }
        for key, value in table.items():
            name = by_word.get(key.replace("-", "_"), key)
            if name not in options or name in _NEVER:
                why = "cannot be set here: pass it on the command line" if name in _NEVER else "no such option"
                known = [word for word, each in by_word.items() if len(word) > 1 and each not in _NEVER]
                hint = "" if name in _NEVER else did_you_mean(key, known) or f"expected one of {', '.join(known)}"
                raise self._error(names, key, why, hint)
            found[name] = self._checked(command, options[name], value, names, key)
        return found

    def _checked(self, command: Any, option: Any, value: Any, table: tuple[str, ...], key: str) -> Any:
        """The value as the parser takes it. Raises InputError for one of the wrong type."""
        expected = "true or false" if option.is_flag else "a list" if option.multiple else "a single value"
        is_single = not isinstance(value, list | dict)
        if option.is_flag != isinstance(value, bool) or not (
            is_single or (option.multiple and isinstance(value, list))
        ):
            raise self._error(table, key, f"expected {expected}, found {value!r}")
        values = value if isinstance(value, list) else [value]
        if option.name in _PATHS:
            values = [self._absolute(each) if isinstance(each, str) else each for each in values]
        found = values if option.multiple else values[0]
        try:
            option.process_value(typer.Context(command), found)
        except typer.BadParameter as error:
            raise self._error(table, key, error.message) from None
        return found

    def _absolute(self, text: str) -> str:
        """Relative to the file's directory."""
        return str(self.path.parent / Path(text).expanduser())

    def _error(self, table: tuple[str, ...], key: str, message: str, hint: str = "") -> InputError:
        name = ".".join((*table, key))
        return InputError(f"{self.path}:{_line_of(self.text, table, key)}: {name}: {message}", hint=hint)


def load(file: str) -> Defaults:
    """The file's contents. Raises InputError with file and line."""
    path = Path(file)
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        why = error.strerror if isinstance(error, OSError) else "not UTF-8 text"
        raise InputError(f"cannot read the configuration {path}: {why}") from error
    try:
        values = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        line = re.search(r"at line (\d+), column (\d+)", str(error))
        place = f"{line[1]}:{line[2]}" if line else f"{len(text.splitlines())}"
        raise InputError(f"{path}:{place}: {str(error).partition(' (at')[0]}", hint="the format is TOML 1.0") from None
    defaults = Defaults(path, text, values)
    for key, value in values.items():
        _check_top_level(defaults, key, value)
    return defaults


def _check_top_level(defaults: Defaults, key: str, value: Any) -> None:
    checks: dict[str, tuple[Callable[[Any], bool], str]] = {
        "color": (lambda given: given in _COLORS, f"one of {', '.join(_COLORS)}"),
        "journal": (lambda given: isinstance(given, str), "the URL of a PostgreSQL database"),
        "parallel": (lambda given: type(given) is int and given >= 1, "an integer of 1 or more"),
        "verbose": (lambda given: type(given) is int and given >= 0, "0, 1 or 2"),
    }
    # `inventory` is an option, and [inventory] the table of a command
    if key in COMMANDS and (key not in _OPTIONS or isinstance(value, dict)):
        if not isinstance(value, dict):
            raise defaults._error((), key, f"expected a table [{key}], found {value!r}")
    elif key not in (*_OPTIONS, *checks):
        known = (*_OPTIONS, "parallel", "color", "journal", *COMMANDS)
        hint = did_you_mean(key, known) or f"expected a command, or one of {', '.join(known[:7])}"
        raise defaults._error((), key, "unknown setting", hint)
    elif key in checks and not checks[key][0](value):
        raise defaults._error((), key, f"expected {checks[key][1]}, found {value!r}")


def _line_of(text: str, table: tuple[str, ...], key: str) -> int:
    """The line of a key in a table, or of the table itself (TOML's parser reports no positions of values)."""
    current: tuple[str, ...] = ()
    for number, line in enumerate(text.splitlines(), 1):
        if header := re.match(r"\s*\[\s*([^\]]+?)\s*\]", line):
            current = tuple(part.strip(" \t\"'") for part in header[1].split("."))
            if current == (*table, key):
                return number
        elif current == table and re.match(rf"""\s*["']?{re.escape(key)}["']?\s*[=.]""", line):
            return number
    return 1
