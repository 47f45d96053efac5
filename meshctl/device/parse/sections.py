"""The frame of observe.sh's output: `NONCE begin NAME`, bytes as they are, a newline, `NONCE end STATUS`."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class OutputSection:
    """What one command printed and its exit status; -1 when the output ends inside it."""

    body: bytes
    status: int

    @property
    def text(self) -> str:
        return self.body.decode("utf-8", "replace")


def split_sections(output: bytes, nonce: str) -> dict[str, OutputSection]:
    """All sections by name, in order. A name that comes twice keeps its first; what is outside sections is dropped."""
    found: dict[str, OutputSection] = {}
    begin, end = f"{nonce} begin ".encode(), f"{nonce} end ".encode()
    name: str | None = None
    body: list[bytes] = []
    for line in output.split(b"\n"):
        if line.startswith(begin):
            name, body = line[len(begin) :].decode("utf-8", "replace"), []
        elif name is not None and line.startswith(end):
            found.setdefault(name, OutputSection(b"\n".join(body), _status(line[len(end) :])))
            name = None
        elif name is not None:
            body.append(line)
    if name is not None:
        found.setdefault(name, OutputSection(b"\n".join(body), -1))
    return found


def _status(text: bytes) -> int:
    return int(text) if text.isdigit() and len(text) < 5 else -1
