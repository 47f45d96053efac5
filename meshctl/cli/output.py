"""All output of commands, made safe for a terminal whatever a device sent.

`echo` prints text, `echo_json` JSON, `echo_bytes` the raw bytes of `--raw`. Live lines (`report.progress`) and the live
screen (`live_screen`) sanitize what they draw themselves.
"""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from meshctl.errors import InputError
from meshctl.report.terminal_escapes import clean, clean_styled, json_safe, one_line

if TYPE_CHECKING:
    from typing import TextIO

    from rich.console import Console


def echo(text: object = "", *, err: bool = False, nl: bool = True, styled: bool = False) -> None:
    """Print text. `styled`: keep color escapes, which are meshctl's own."""
    _write(clean_styled(str(text)) if styled else clean(str(text)), err=err, nl=nl)


def echo_json(text: str, *, err: bool = False, nl: bool = True) -> None:
    """Print JSON text, escaped without changing its value."""
    _write(json_safe(text), err=err, nl=nl)


def echo_error(text: str) -> None:
    """Print text on standard error, wrapped if it is a terminal."""
    echo_lines(text, err=True)


def echo_lines(text: str, *, err: bool = False) -> None:
    """Print text, wrapped between words if the stream is a terminal."""
    width = terminal_width(sys.stderr if err else sys.stdout)
    if width is not None:
        # imported only where it is needed: this module is part of every start
        from meshctl.report.line_wrap import wrap

        text = "\n".join(part for line in clean(text).split("\n") for part in wrap(line, width))
    echo(text, err=err)


def terminal_width(stream: TextIO) -> int | None:
    """The width of the terminal that the stream writes to, or COLUMNS there; None for a pipe or a file."""
    if not stream.isatty():
        return None
    given = os.environ.get("COLUMNS", "")
    try:
        return int(given) if given.isdecimal() and int(given) else os.get_terminal_size(stream.fileno()).columns or None
    except OSError:
        return None


def echo_bytes(raw: bytes, *, err: bool = False) -> None:
    """Print bytes unchanged."""
    _write(raw, err=err, nl=False)


_needs_reader = True


@contextmanager
def outlive_reader() -> Iterator[None]:
    """Within it, output whose reader is gone is discarded, and the command continues: it changes something, and asks no
    question."""
    global _needs_reader
    _needs_reader = False
    try:
        yield
    finally:
        _needs_reader = True


def _write(text: str | bytes, *, err: bool, nl: bool) -> None:
    try:
        typer.echo(text, err=err, nl=nl)
    except BrokenPipeError:
        lose_reader()


def lose_reader() -> None:
    """Called while a BrokenPipeError is handled: raises it again, or discards the output from now on."""
    if _needs_reader:
        raise
    discard_output()


def write_file(path: Path, content: str | bytes, *, inventory: Iterable[str] = (), inputs: Iterable[Path] = ()) -> None:
    """Write the file that an option names, such as `--out`. Raises InputError with the reason if that fails, or if it
    is one of the inventory's or of the command's other inputs; an earlier file then stays as it was."""
    target = os.path.realpath(path)
    if target in map(os.path.realpath, inventory):
        raise InputError(f"{path} is a file of the inventory, and would be overwritten", hint="name another file")
    if target in map(os.path.realpath, inputs):
        raise InputError(f"{path} is an input of this command, and would be overwritten", hint="name another file")
    data = content.encode() if isinstance(content, str) else content
    try:
        if path.exists() and not path.is_file():
            path.write_bytes(data)  # a pipe, /dev/stdout
        else:
            _replace(Path(os.path.realpath(path)), data)
    except OSError as error:
        raise InputError(f"cannot write {path}: {error.strerror}") from error


def _replace(target: Path, data: bytes) -> None:
    temporary = target.with_name(f".{target.name}.{os.getpid()}")
    try:
        descriptor = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666)
    except PermissionError:
        target.write_bytes(data)  # a file that is writable in a directory that is not
        return
    try:
        with open(descriptor, "wb") as stream:
            stream.write(data)
        with suppress(FileNotFoundError):
            os.chmod(temporary, target.stat().st_mode & 0o7777)
        os.replace(temporary, target)
    except OSError:
        temporary.unlink(missing_ok=True)
        raise


def is_plain() -> bool:
    """Whether NO_COLOR is set (no-color.org), or the terminal understands no escapes."""
    return bool(os.environ.get("NO_COLOR")) or is_dumb()


def is_dumb() -> bool:
    """Whether the terminal understands no escapes, such as an editor's shell."""
    return os.environ.get("TERM") == "dumb"


def has_transient_line() -> bool:
    """Whether standard error is a terminal on which a line can be replaced."""
    return sys.stderr.isatty() and not is_dumb()


def transient_line(text: str) -> None:
    """Replace the current line of the terminal, shortened to its width; an empty text erases it."""
    shown, room = one_line(text), shutil.get_terminal_size().columns - 1
    if len(shown) > room:
        # whole words: half a name is another node's
        shown = shown[: room - 3].rpartition(" ")[0] + " ..."
    # the terminal may be closed
    with suppress(OSError):
        sys.stderr.write(f"\r\x1b[K{shown}")
        sys.stderr.flush()


def console() -> Console:
    """Standard output for rich, without styles when NO_COLOR is set."""
    from rich.console import Console

    class PipedConsole(Console):
        def on_broken_pipe(self) -> None:
            # rich would exit with 1
            lose_reader()

    return PipedConsole(color_system=None if is_plain() else "auto", highlight=False, markup=False)


def prepare_streams() -> None:
    """Escape characters that the terminal's encoding lacks instead of failing; replace closed streams by /dev/null.

    Without the latter, the next file that is opened would be standard output (`meshctl status >&-`).
    """
    for name in ("stdin", "stdout", "stderr"):
        if getattr(sys, name) is None:
            # the lowest free number, which is this stream's
            null = os.open(os.devnull, os.O_RDWR)
            setattr(sys, name, open(null, "r" if name == "stdin" else "w", encoding="utf-8"))  # noqa: SIM115
    for stream in (sys.stdout, sys.stderr):
        reconfigure = getattr(stream, "reconfigure", None)
        if reconfigure is not None:
            reconfigure(errors="backslashreplace")


@contextmanager
def ignore_broken_pipe() -> Iterator[None]:
    """Stop writing to standard output once its reader is gone (EPIPE, EIO), without an error."""
    try:
        yield
        sys.stdout.flush()
    except OSError:
        discard_output()


def discard_output() -> None:
    """Write nothing more to standard output, or the interpreter flushes, and complains, once more at exit."""
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, sys.stdout.fileno())
    os.close(null)
