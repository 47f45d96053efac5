"""Commands and groups of commands: their help, and a group with a command of its own for words that name none."""

from __future__ import annotations

import inspect
import re
import sys
import textwrap
from pathlib import Path
from typing import Any, ClassVar, get_args, get_origin

from typer import BadParameter
from typer.core import TyperArgument, TyperCommand, TyperGroup

_MIN_EXAMPLE_WIDTH = 20
_POINT = "POINT"
_COORDINATES = re.compile(r"-[0-9.]+,[-0-9.]+")
_METAVARS = {Path: "PATH", int: "N", float: "NUMBER"}


class Command(TyperCommand):
    """Names values in its help by what they are, where newer typers show Python's types (`--key <list[Path]>`)."""

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        for parameter in self.params:
            _name_value(parameter)

    def format_help_text(self, ctx: Any, formatter: Any) -> None:
        """Folds the example as a shell reads it: copied from a narrow terminal, it is still one command."""
        whole = self.help
        self.help, *examples = inspect.cleandoc(whole or "").split("\n\nExample: ")
        try:
            super().format_help_text(ctx, formatter)
        finally:
            self.help = whole
        for example in examples:
            formatter.write_paragraph()
            with formatter.indentation():
                formatter.write(_folded(f"Example: {' '.join(example.split())}", formatter) + "\n")

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        words = args
        if any(parameter.metavar == _POINT for parameter in self.params):
            # click takes coordinates such as `-3,20` for options
            words = [f" {word}" if _COORDINATES.fullmatch(word) else word for word in args]
        try:
            return super().parse_args(ctx, words)
        except BadParameter as error:
            error.message = _reworded(error)
            raise


def _folded(command: str, formatter: Any) -> str:
    indent = " " * formatter.current_indent
    width = max(formatter.width - len(" \\"), _MIN_EXAMPLE_WIDTH)
    lines = textwrap.wrap(
        command,
        width,
        initial_indent=indent,
        subsequent_indent=2 * indent,
        break_long_words=False,
        break_on_hyphens=False,
    )
    return " \\\n".join(lines)


# pydantic's messages: newer typers check values with it
_WORDINGS = {
    "Value error, ": "",
    "Input should be a valid integer.*": "expected a whole number",
    "Input should be a valid number.*": "expected a number",
    "Input should be ((greater|less) than)": r"expected a value \1",
}


def _reworded(error: BadParameter) -> str:
    """The message in our words, with the value if the message lacks it."""
    text = error.message
    for pattern, ours in _WORDINGS.items():
        text = re.sub(f"^{pattern}", ours, text)
    details: list[Any] = getattr(error.__cause__, "errors", list)()
    value = str(details[0]["input"]) if details else ""
    return text if not value or repr(value) in text else f"{text}, found {value!r}"


def _name_value(parameter: Any) -> None:
    described = getattr(parameter, "type_descriptor", None)
    if described is None or described.is_choice:
        # an older typer, which names values itself, or a list of values
        return
    if isinstance(parameter, TyperArgument):
        # its name is enough
        vars(parameter)["display_type_rich"] = lambda ctx: None
    elif parameter.metavar is None and not parameter.is_flag and not parameter.count:
        kind = described.annotation
        kind = get_args(kind)[0] if get_origin(kind) is list else kind
        parameter.metavar = _METAVARS.get(kind) or parameter.name.upper()


class CommandGroup(TyperGroup):
    """Lists commands with their whole summaries, which click would cut at the end of the line."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        summaries = [(name, command.get_short_help_str(sys.maxsize)) for name, command in self.commands.items()]
        with formatter.section("Commands"):
            formatter.write_dl(summaries)


class ImportGroup(CommandGroup):
    """`meshctl inventory import FILE` is `meshctl inventory import csv FILE`."""

    default_command: ClassVar[str] = "csv"

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        if args and args[0] not in self.commands and args[0] not in ctx.help_option_names:
            args = [self.default_command, *args]
        return super().parse_args(ctx, args)
