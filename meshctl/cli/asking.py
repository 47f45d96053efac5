"""Ask a person before nodes are changed."""

from __future__ import annotations

import sys

import typer

from meshctl.cli.output import echo
from meshctl.errors import ExitCode, InputError


def must_agree(question: str) -> None:
    """Return when the answer is yes.

    Raises InputError where nobody can be asked, typer.Exit when the answer is no, typer.Abort at Ctrl-C or the end of
    input.
    """
    if not sys.stdin.isatty():
        raise InputError("nobody can be asked here", hint="look at what would be done, then run again with --yes")
    if not typer.confirm(question):
        echo("nothing was changed", err=True)
        raise typer.Exit(int(ExitCode.FINDINGS))
