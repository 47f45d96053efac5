"""The frame of observe.sh's output: `NONCE begin NAME`, bytes as they are, a newline, `NONCE end STATUS`.

After a line `NONCE gzip`, the rest is compressed.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass

# The limit of an answer that is not compressed (ssh_channel.MAX_OUTPUT_BYTES); the rest of a longer one is cut off.
MAX_INFLATED_BYTES = 16 << 20
_GZIP_WBITS = 16 + zlib.MAX_WBITS


@dataclass(frozen=True, slots=True)
class OutputSection:
    """Output and exit status of one command; -1 when the output ends inside it."""

    body: bytes
    status: int

    @property
    def text(self) -> str:
        return self.body.decode("utf-8", "replace")


def split_sections(output: bytes, nonce: str) -> dict[str, OutputSection]:
    """All sections by name, in order. A name that comes twice keeps its first; what is outside sections is dropped."""
    found: dict[str, OutputSection] = {}
    _, is_compressed, packed = output.partition(f"{nonce} gzip\n".encode())
    if is_compressed:
        output = _inflated(packed)
    name: str | None = None
    body: list[bytes] = []
    # at the nonce instead of line by line: most of an answer is one long table
    mark = f"{nonce} ".encode()
    for piece in (b"\n" + output).split(b"\n" + mark)[1:]:
        line, line_break, rest = piece.partition(b"\n")
        if line.startswith(b"begin "):
            name, body = line[len(b"begin ") :].decode("utf-8", "replace"), [rest] if line_break else []
        elif name is not None and line.startswith(b"end "):
            found.setdefault(name, OutputSection(b"\n".join(body), _status(line[len(b"end ") :])))
            name = None
        elif name is not None:
            body.append(mark + piece)
    if name is not None:
        found.setdefault(name, OutputSection(b"\n".join(body), -1))
    return found


def _inflated(packed: bytes) -> bytes:
    """The readable part: all, or the beginning of an answer that was cut short."""
    try:
        return zlib.decompressobj(_GZIP_WBITS).decompress(packed, MAX_INFLATED_BYTES)
    except zlib.error:
        return b""


def _status(text: bytes) -> int:
    return int(text) if text.isdigit() and len(text) < 5 else -1
