"""Output of the commands: text and JSON on standard output, errors on standard error, exit codes."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from enum import IntEnum

from udp_mesh.report.terminal_escapes import clean, json_safe


class Exit(IntEnum):
    """Exit codes of every command."""

    OK = 0
    FAILED = 1
    """The daemon refused the request, a peer did not answer, or a file could not be written (`keygen`, `hosts`)."""
    USAGE = 2
    UNREACHABLE = 3
    """No daemon listens at the socket."""
    CONFIGURATION = 4
    """The configuration is invalid; the problems are on standard error."""
    NOT_DELIVERED = 5
    """A message expired or its peer was lost."""
    INTERRUPTED = 130
    """Ctrl-C: 128 plus the signal number, as in shells."""


class OutputFailed(Exception):
    """Standard output cannot be written (a full disk); a closed pipe raises BrokenPipeError instead."""


def prepare_streams() -> None:
    """Makes standard output and standard error safe to write to: a closed one is replaced by /dev/null, and characters
    missing from the terminal's encoding are escaped."""
    if sys.stdout is None:
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115
    if sys.stderr is None:
        sys.stderr = open(os.devnull, "w")  # noqa: SIM115
    reconfigure = getattr(sys.stdout, "reconfigure", None)
    if reconfigure is not None:
        reconfigure(errors="backslashreplace")


def discard_stdout() -> None:
    """Discards everything written to standard output from now on, including what Python still buffers."""
    with suppress(OSError, ValueError):
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, sys.stdout.fileno())
        os.close(null)


@contextmanager
def checked_stdout() -> Iterator[None]:
    """Turns an OSError of standard output into OutputFailed, or lets BrokenPipeError pass."""
    try:
        yield
    except BrokenPipeError:
        raise
    except OSError as error:
        raise OutputFailed(error.strerror) from error


def print_text(text: str) -> None:
    write_text(text + "\n")


def write_text(text: str) -> None:
    """Prints text without a line end."""
    write_raw(clean(text))


def write_raw(text: str) -> None:
    """Writes text that may contain our own control sequences; foreign text in it must be cleaned before."""
    with checked_stdout():
        sys.stdout.write(text)
        sys.stdout.flush()


def write_bytes(raw: bytes) -> None:
    with checked_stdout():
        sys.stdout.buffer.write(raw)
        sys.stdout.buffer.flush()


def print_json(value: object) -> None:
    print_text(json_safe(json.dumps(value, indent=2, ensure_ascii=_is_ascii_safer())))


def print_json_line(value: object) -> None:
    print_text(json_safe(json.dumps(value, separators=(",", ":"), ensure_ascii=_is_ascii_safer())))


def _is_ascii_safer() -> bool:
    """Whether JSON escapes are needed because the encoding lacks some characters."""
    return (sys.stdout.encoding or "").lower().replace("-", "") != "utf8"


def print_error(text: str) -> None:
    sys.stderr.write(f"udp-mesh: {clean(text)}\n")


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Columns as wide as their content, numbers aligned to the right."""
    # A line break in a name must not start a new row.
    cells = [[clean(cell, keep="") for cell in row] for row in (head, *rows)]
    widths = [max(len(row[column]) for row in cells) for column in range(len(head))]
    numeric = [all(_is_number(row[column]) for row in rows) for column in range(len(head))]
    return "\n".join(
        "  ".join(
            cell.rjust(width) if right else cell.ljust(width)
            for cell, width, right in zip(row, widths, numeric, strict=True)
        ).rstrip()
        for row in cells
    )


def _is_number(cell: str) -> bool:
    return cell in ("-", "") or cell[0].isdigit()


def rate(bits_per_s: float | None) -> str:
    """`9.41 Mbit/s`."""
    return "-" if bits_per_s is None else f"{scaled(bits_per_s)}bit/s"


def size(count: float) -> str:
    """`1.50 MB`."""
    return f"{scaled(count)}B"


def scaled(value: float) -> str:
    for factor, prefix in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if value >= factor:
            return f"{value / factor:.3g} {prefix}"
    return f"{value:.3g} "


def milliseconds(seconds: float | None) -> str:
    """`1.82 ms`, `340 ms`, `18.2 s`."""
    if seconds is None:
        return "-"
    return f"{seconds * 1000:.3g} ms" if seconds < 0.9995 else duration(seconds)


def counted(number: int, noun: str) -> str:
    """`1 peer`, `2 peers`."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def duration(seconds: float | None) -> str:
    """`1 h 02 min`, `3 min 10 s`, `4.2 s`."""
    if seconds is None:
        return "-"
    if seconds >= 3600:
        return f"{int(seconds // 3600)} h {int(seconds % 3600 // 60):02d} min"
    if seconds >= 60:
        return f"{int(seconds // 60)} min {int(seconds % 60):02d} s"
    return f"{seconds:.1f} s"


def fields_text(fields: Mapping[str, object]) -> str:
    return " ".join(f"{key}={value}" for key, value in fields.items() if value is not None)
