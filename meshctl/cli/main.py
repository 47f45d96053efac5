"""The root command: find the command that is meant, import it alone, run it, turn errors into exit codes.

`main` reads the words on the command line (or those being completed), registers the meant command for real and every
other one by its summary only, and hands over to typer.
"""

from __future__ import annotations

import functools
import importlib
import os
import sys
from collections.abc import Callable, Sequence
from typing import Annotated, Any

import typer
from typer.core import DEFAULT_MARKUP_MODE

from meshctl import __version__
from meshctl.cli.commands import COMMANDS, Entry
from meshctl.cli.extensions import load
from meshctl.cli.output import echo, ignore_broken_pipe, is_plain, prepare_streams
from meshctl.errors import ExitCode, MeshctlError

_EPILOG = """Start with `meshctl init DIR`, or `meshctl lab up` for a virtual fleet to practise on.

Exit codes: 0 well, 1 something to act on, 2 could not run, 3 needed nodes do not answer, 130 interrupted."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run meshctl with `arguments` (default: the process's own); always ends in SystemExit."""
    prepare_streams()
    words = list(sys.argv[1:] if arguments is None else arguments)
    completing = os.environ.get("COMP_WORDS", "").split()[1:] if "_MESHCTL_COMPLETE" in os.environ else []
    meant = next((word for word in completing or words if not word.startswith("-")), "")
    try:
        build(meant)(args=words, prog_name="meshctl")
    except KeyboardInterrupt:
        # while the command was being imported, which takes seconds on a busy machine
        echo("interrupted", err=True)
        sys.exit(int(ExitCode.INTERRUPTED))


def build(meant: str) -> typer.Typer:
    """The application, with only the command `meant` imported."""
    app = typer.Typer(
        name="meshctl",
        help="Own a fleet of mesh radios from one inventory: lint, render, provision, watch.",
        epilog=_EPILOG,
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        # without it help and usage errors are plain text
        rich_markup_mode=None if is_plain() else DEFAULT_MARKUP_MODE,
        context_settings={"help_option_names": ["-h", "--help"]},
    )
    app.callback()(_root)
    for name, entry in COMMANDS.items():
        if name == meant:
            _register(app, name, entry)
        else:
            app.command(name, help=entry.summary, rich_help_panel=entry.panel)(_placeholder)
    return app


def _root(
    version: Annotated[
        bool,
        typer.Option("--version", help="Print the version and exit.", is_eager=True, callback=lambda v: _version(v)),
    ] = False,
) -> None:
    """Own a fleet of mesh radios from one inventory: lint, render, provision, watch."""


def _version(wanted: bool) -> None:
    if wanted:
        echo(f"meshctl {__version__}")
        raise typer.Exit


def _placeholder() -> None:
    raise AssertionError("a command that was not named was called")


def _register(app: typer.Typer, name: str, entry: Entry) -> None:
    target = getattr(importlib.import_module(entry.module), entry.attribute) if entry.module else load(name)
    if isinstance(target, typer.Typer):
        _guard_group(target)
        app.add_typer(target, name=name, help=entry.summary, rich_help_panel=entry.panel, no_args_is_help=True)
    else:
        # what follows `--` in `meshctl run NODE -- CMD -x` belongs to the command on the node
        app.command(name, rich_help_panel=entry.panel)(_guarded(target))


def _guard_group(group: typer.Typer) -> None:
    for command in group.registered_commands:
        if command.callback is not None:
            command.callback = _guarded(command.callback)
    for inner in group.registered_groups:
        if inner.typer_instance is not None:
            _guard_group(inner.typer_instance)


def _guarded(command: Callable[..., Any]) -> Callable[..., Any]:
    """The command with meshctl's errors and Ctrl-C turned into a message and an exit code."""

    @functools.wraps(command)
    def run(*args: Any, **kwargs: Any) -> Any:
        try:
            return command(*args, **kwargs)
        except MeshctlError as error:
            echo(f"error: {error}", err=True)
            if error.hint:
                echo(f"hint: {error.hint}", err=True)
            raise typer.Exit(int(error.exit_code)) from None
        except (KeyboardInterrupt, typer.Abort):
            echo("interrupted", err=True)
            raise typer.Exit(int(ExitCode.INTERRUPTED)) from None
        except BrokenPipeError:
            # the reader (`| head`) has seen enough
            with ignore_broken_pipe():
                raise
            raise typer.Exit from None

    return run
