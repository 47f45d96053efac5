"""Bytes of one inventory file -> text, or a diagnostic."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from meshctl.diagnostics import Diagnostic, Position
from meshctl.inventory import codes

# 10,000 individually written nodes take about 5 MB; more is a mistake or an attack on memory.
MAX_FILE_BYTES = 16 * 1024 * 1024

# Printable characters by YAML 1.1 section 5.1, without the byte order mark.
_UNPRINTABLE = re.compile("[^\t\n\r\x20-\x7e\x85\xa0-\ud7ff\ue000-\ufefe\uff00-\ufffd\U00010000-\U0010ffff]")

Reader = Callable[[Path], bytes]


@dataclass(frozen=True, slots=True)
class Source:
    """A file's text, and its name in diagnostics."""

    file: str
    text: str


def read_bytes(path: Path) -> bytes:
    """Read at most `MAX_FILE_BYTES` + 1 bytes. Raises OSError."""
    with path.open("rb") as stream:
        return stream.read(MAX_FILE_BYTES + 1)


def read_source(path: Path, read: Reader = read_bytes) -> Source | Diagnostic:
    """The text of `path`; a diagnostic if it is unreadable, too large, not UTF-8 or contains control characters."""
    file = str(path)
    try:
        content = read(path)
    except (OSError, ValueError) as reason:
        why = reason.strerror if isinstance(reason, OSError) and reason.strerror else str(reason)
        return codes.error(codes.UNREADABLE, Position(file), f"cannot be read: {why}")
    if len(content) > MAX_FILE_BYTES:
        return codes.error(
            codes.TOO_LARGE,
            Position(file),
            "the file is too large",
            expected=f"at most {MAX_FILE_BYTES} bytes",
            hint="write similar nodes as a range (`b[001-500]`), and shared values as a group",
        )
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as reason:
        line = content.count(b"\n", 0, reason.start) + 1
        column = reason.start - content.rfind(b"\n", 0, reason.start)
        return codes.error(
            codes.NOT_TEXT,
            Position(file, line, column),
            "the file is not UTF-8 text",
            found=f"the byte 0x{content[reason.start]:02x}",
            hint="save the file as UTF-8",
        )
    bad = _UNPRINTABLE.search(text)
    if bad is not None:
        return codes.error(
            codes.NOT_TEXT,
            Position(file, text.count("\n", 0, bad.start()) + 1, bad.start() - text.rfind("\n", 0, bad.start())),
            "control characters are not allowed",
            found=f"U+{ord(bad.group()):04X}",
        )
    return Source(file, text)
