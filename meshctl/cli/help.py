"""`meshctl help COMMAND`: the same as `meshctl COMMAND --help`."""

from __future__ import annotations

from typing import Annotated

import typer


def help_command(
    command: Annotated[list[str] | None, typer.Argument(help="Command, such as `robots deploy`; default: all.")] = None,
) -> None:
    """Show the help of a command.

    Example: meshctl help robots deploy
    """
    from meshctl.cli.main import main

    main([*(command or ()), "--help"])
