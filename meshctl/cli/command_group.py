"""Groups of commands: their help, and a group with a command of its own for words that name none."""

from __future__ import annotations

import sys
from typing import Any, ClassVar

from typer.core import TyperGroup


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
