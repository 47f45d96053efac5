"""Messages in pieces that a NATS server accepts: its limit is 1 MiB unless its administrator raised it. Pure."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

MAX_CHUNK_BYTES = 512 << 10
# A part of an inventory with its packages, or a firmware image.
MAX_MESSAGE_BYTES = 64 << 20
_MAX_INCOMPLETE = 16
# The header of a piece: `ID NUMBER/COUNT`.
HEADER = "Meshctl-Piece"


@dataclass(frozen=True, slots=True)
class Chunk:
    """A piece: the `number`th (from 1) of `count` of the message `message`."""

    message: str
    number: int
    count: int
    data: bytes = field(repr=False)

    @property
    def header(self) -> str:
        return f"{self.message} {self.number}/{self.count}"


def chunks_of(message: str, data: bytes) -> Iterator[Chunk]:
    count = max(1, -(-len(data) // MAX_CHUNK_BYTES))
    for number in range(count):
        yield Chunk(message, number + 1, count, data[number * MAX_CHUNK_BYTES : (number + 1) * MAX_CHUNK_BYTES])


def parse_chunk(header: str, data: bytes) -> Chunk:
    """Raises ValueError for a header that is none."""
    message, _, place = header.partition(" ")
    number, _, count = place.partition("/")
    found = Chunk(message, int(number), int(count), data)
    if not message or not 1 <= found.number <= found.count <= MAX_MESSAGE_BYTES // MAX_CHUNK_BYTES:
        raise ValueError(f"{header!r} is no piece of a message")
    return found


class Assembler:
    """Puts messages together from their pieces, which may come twice or in any order."""

    def __init__(self) -> None:
        self._incomplete: dict[str, dict[int, bytes]] = {}

    def add(self, chunk: Chunk) -> bytes | None:
        """The whole message, with its last piece."""
        if chunk.count == 1:
            return chunk.data
        found = self._incomplete.setdefault(chunk.message, {})
        found[chunk.number] = chunk.data
        if len(found) < chunk.count:
            while len(self._incomplete) > _MAX_INCOMPLETE:
                self._incomplete.pop(next(iter(self._incomplete)))
            return None
        del self._incomplete[chunk.message]
        return b"".join(found[number] for number in sorted(found))


@dataclass(frozen=True, slots=True)
class StoredMessage:
    """A message of a stream. `acknowledge` tells the stream to delete it; `later` to deliver it again."""

    subject: str
    chunk: Chunk
    acknowledge: Callable[[], None]
    later: Callable[[float], None]
