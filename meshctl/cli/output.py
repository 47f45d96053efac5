"""Everything that a command prints goes through here, and is safe for a terminal whatever a device put into it.

`echo` prints text, `echo_json` JSON, `echo_bytes` what `--raw` asks for. Live lines (`report.progress`) and pages
(`live`) clean what they draw themselves.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import typer

from meshctl.report.terminal_escapes import clean, clean_styled, json_safe

if TYPE_CHECKING:
    from rich.console import Console


def echo(text: object = "", *, err: bool = False, nl: bool = True, styled: bool = False) -> None:
    """Print text. `styled`: its colours are meshctl's own, and pass."""
    shown = clean_styled(str(text)) if styled else clean(str(text))
    typer.echo(shown, err=err, nl=nl)


def echo_json(text: str, *, err: bool = False, nl: bool = True) -> None:
    """Print JSON text; it stays the same value."""
    typer.echo(json_safe(text), err=err, nl=nl)


def echo_error(text: str) -> None:
    """Print text on standard error."""
    echo(text, err=True)


def echo_bytes(raw: bytes, *, err: bool = False) -> None:
    """Pass bytes through as they are."""
    typer.echo(raw, err=err, nl=False)


def is_plain() -> bool:
    """Whether nothing is to be coloured or set in bold (no-color.org)."""
    return bool(os.environ.get("NO_COLOR"))


def console() -> Console:
    """Standard output for rich, without colours and bold where those are unwanted."""
    from rich.console import Console

    return Console(color_system=None if is_plain() else "auto", highlight=False, markup=False)


def prepare_streams() -> None:
    """Characters that a terminal's encoding lacks are shown by their numbers, instead of an error."""
    for stream in (sys.stdout, sys.stderr):
        reconfigure = getattr(stream, "reconfigure", None)
        if reconfigure is not None:
            reconfigure(errors="backslashreplace")


@contextmanager
def ignore_broken_pipe() -> Iterator[None]:
    """Within this block a write that fails (EPIPE, EIO) is the last that is tried."""
    try:
        yield
        sys.stdout.flush()
    except OSError:
        # keeps the interpreter from trying, and complaining, once more at its exit
        silence = os.open(os.devnull, os.O_WRONLY)
        os.dup2(silence, sys.stdout.fileno())
        os.close(silence)
