"""The root command: import the requested command alone, run it, turn errors into exit codes.

`main` reads the command line (or the words being completed), registers the requested command in full and every other
one by its summary only, and hands over to typer.
"""

from __future__ import annotations

import atexit
import errno
import functools
import gc
import importlib
import os
import shlex
import sys
from collections.abc import Callable, MutableMapping, Sequence
from contextlib import nullcontext
from itertools import groupby
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperGroup

from meshctl import __version__
from meshctl.cli.command_group import Command, CommandGroup
from meshctl.cli.commands import COMMANDS, Entry
from meshctl.cli.extensions import load
from meshctl.cli.output import discard_output, echo, echo_lines, ignore_broken_pipe, outlive_reader, prepare_streams
from meshctl.errors import ExitCode, InputError, MeshctlError
from meshctl.start_up import raise_at_ctrl_c

if TYPE_CHECKING:
    from meshctl.cli.user_config import Defaults

_EPILOG = """Start with `meshctl init DIR`, or with `meshctl lab up` for a virtual fleet.

Exit codes: 0 success, 1 findings, 2 could not run, 3 required nodes unreachable, 130 interrupted."""

_DISK_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
# Lines longer than this are hard to read.
MAX_HELP_COLUMNS = 100
# Objects created before the youngest are searched for cycles, and collections before the next older generation is.
GC_THRESHOLD = (50_000, 20, 50)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run meshctl with `arguments` (default: sys.argv); always raises SystemExit."""
    prepare_streams()
    words = list(sys.argv[1:] if arguments is None else arguments)
    completing = os.environ.get("COMP_WORDS", "").split()[1:] if "_MESHCTL_COMPLETE" in os.environ else []
    requested = next((word for word in completing or words if not word.startswith("-")), "")
    # a fleet's answers are hundreds of thousands of objects without cycles: by default, a quarter of status is spent
    # looking for some; a caller's process keeps its own thresholds
    if arguments is None:
        gc.set_threshold(*GC_THRESHOLD)
        # the interpreter searches all objects once more when it ends: a tenth of a short command
        atexit.register(gc.freeze)
        # paramiko imports it for `Match exec` of an ssh_config, which meshctl does not read, and does without it; that
        # was a quarter of paramiko's start
        sys.modules.setdefault("invoke", None)  # type: ignore[arg-type]
    # no plugin takes part in reading an inventory, and to look for some reads the metadata of all installed packages
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")
    try:
        defaults = user_defaults(os.environ)
        command = typer.main.get_command(build(requested))
        command(args=words, prog_name="meshctl", default_map=default_map(defaults, requested, command))
    except MeshctlError as error:
        _print_error(error)
        sys.exit(int(error.exit_code))
    except OSError as error:
        # an error of a stream; files have names
        if error.errno not in _DISK_FULL or error.filename is not None:
            raise
        discard_output()
        _print_error(MeshctlError(f"cannot write the output: {error.strerror}"))
        sys.exit(int(ExitCode.COULD_NOT_RUN))
    except KeyboardInterrupt:
        # during the import of the command, which takes seconds on a busy machine
        echo("interrupted", err=True)
        sys.exit(int(ExitCode.INTERRUPTED))


def user_defaults(environ: MutableMapping[str, str]) -> Defaults | None:
    """The user's configuration file, if there is one; sets the environment variables it stands for.

    Raises InputError with file and line for an invalid file.
    """
    named = environ.get("MESHCTL_CONFIG")
    root = environ.get("XDG_CONFIG_HOME") or os.path.join(environ.get("HOME", "/"), ".config")
    path = os.path.join(root, "meshctl", "config.toml") if named is None else os.path.expanduser(named)
    if named == "" or (named is None and not os.path.exists(path)):
        return None
    # imported only for those who have such a file: this is part of every start
    from meshctl.cli.user_config import load

    defaults = load(path)
    for name, value in defaults.environment.items():
        environ.setdefault(name, value)
    return defaults


def default_map(defaults: Defaults | None, requested: str, command: Any) -> dict[str, Any] | None:
    """Defaults of the requested command from the user's file, for click."""
    if defaults is None or requested not in COMMANDS:
        return None
    return {requested: defaults.for_command(requested, command.commands[requested])}


def build(requested: str) -> typer.Typer:
    """The application, with only the `requested` command imported."""
    app = typer.Typer(
        name="meshctl",
        help="Manage a fleet of OpenWrt mesh radios from one inventory.",
        epilog=_EPILOG,
        no_args_is_help=True,
        cls=_RootGroup,
        pretty_exceptions_enable=False,
        # plain help and usage errors: importing rich for its boxes takes longer than everything else
        rich_markup_mode=None,
        context_settings={"help_option_names": ["-h", "--help"], "max_content_width": MAX_HELP_COLUMNS},
    )
    app.callback()(_root)
    for name, entry in COMMANDS.items():
        if name == requested:
            _register(app, name, entry)
        else:
            app.command(name, help=entry.summary)(_placeholder)
    return app


class _RootGroup(TyperGroup):
    """Lists the commands under the headings of their table, in its order."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        named = next((place for place, word in enumerate(args) if word in COMMANDS), 0)
        if named and args[0].startswith("-") and args[0] not in (*ctx.help_option_names, "--version"):
            # behind the commands of a group, before the words of a command for nodes
            end = args.index("--") if "--" in args else len(args)
            moved = ["meshctl", *args[named:end], *args[:named], *args[end:]]
            raise InputError("options follow the command", hint=shlex.join(moved))
        if "--install-completion" in args[:1]:
            from meshctl.cli.completion_setup import checked_installation

            with checked_installation():
                return super().parse_args(ctx, args)
        return super().parse_args(ctx, args)

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        # one column of names for all sections
        widest = max(map(len, COMMANDS))
        for heading, entries in groupby(COMMANDS.items(), lambda item: item[1].heading):
            with formatter.section(heading):
                formatter.write_dl([(name.ljust(widest), entry.summary) for name, entry in entries])


def _root(
    version: Annotated[
        bool,
        typer.Option("--version", help="Print the version and exit.", is_eager=True, callback=lambda v: _version(v)),
    ] = False,
) -> None:
    """Manage a fleet of OpenWrt mesh radios from one inventory."""


def _version(requested: bool) -> None:
    if requested:
        echo(f"meshctl {__version__}")
        raise typer.Exit


def _placeholder() -> None:
    raise AssertionError("a command other than the requested one was called")


def _register(app: typer.Typer, name: str, entry: Entry) -> None:
    target = getattr(importlib.import_module(entry.module), entry.attribute) if entry.module else load(name)
    if isinstance(target, typer.Typer):
        _prepare_group(target)
        app.add_typer(target, name=name, cls=CommandGroup, help=entry.summary, no_args_is_help=True)
    else:
        # words after `--` in `meshctl run NODE -- CMD -x` belong to the command on the node
        app.command(name, cls=Command)(_guarded(target))


def _print_error(error: MeshctlError) -> None:
    echo_lines(f"error: {error}", err=True)
    if error.hint:
        echo_lines(f"hint: {error.hint}", err=True)


def _prepare_group(group: typer.Typer) -> None:
    for command in group.registered_commands:
        command.cls = Command
        if command.callback is not None:
            command.callback = _guarded(command.callback)
    for inner in group.registered_groups:
        if not (isinstance(inner.cls, type) and issubclass(inner.cls, CommandGroup)):
            inner.cls = CommandGroup
        if inner.typer_instance is not None:
            _prepare_group(inner.typer_instance)


def _guarded(command: Callable[..., Any]) -> Callable[..., Any]:
    """Turn meshctl's errors and Ctrl-C into a message and an exit code, and add the options that all commands have."""
    if "is_guarded" in vars(command):
        # the commands of a group are guarded in place, and the group may be registered again
        return command
    # here, because the root command's help does not need it
    from meshctl.cli.verbosity import with_verbosity

    command = with_verbosity(command)

    @functools.wraps(command)
    def run(*args: Any, **kwargs: Any) -> Any:
        raise_at_ctrl_c()
        try:
            with outlive_reader() if kwargs.get("yes") else nullcontext():
                return command(*args, **kwargs)
        except MeshctlError as error:
            _print_error(error)
            raise typer.Exit(int(error.exit_code)) from None
        except (KeyboardInterrupt, typer.Abort):
            echo("interrupted", err=True)
            raise typer.Exit(int(ExitCode.INTERRUPTED)) from None
        except BrokenPipeError:
            # the reader (`| head`) is gone
            with ignore_broken_pipe():
                raise
            raise typer.Exit from None

    vars(run)["is_guarded"] = True
    return run
