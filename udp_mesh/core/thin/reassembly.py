"""Parts of messages in, whole messages out; bounded in number, size and time."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass, field

from udp_mesh.wire.thin import Part

MAX_PARTIALS = 16
"""Unfinished messages of all senders, each of at most 32 parts of 255 bytes: 130 kB. The oldest makes room."""
MAX_PARTIALS_PER_SENDER = 4
PARTIAL_S = 180.0
"""Time without a new part after which an unfinished message is dropped: longer than a sender tries."""

_Key = tuple[bytes, int]
"""Boot tag and number of the message."""


@dataclass(slots=True)
class Partial:
    """An unfinished message."""

    count: int
    first: Part | None = None
    parts: dict[int, bytes] = field(default_factory=dict)
    changed_at: float = 0.0

    @property
    def bitmap(self) -> int:
        return sum(1 << index for index in self.parts)


class ThinReassembly:
    """See the module's docstring."""

    def __init__(self) -> None:
        self._partials: OrderedDict[_Key, Partial] = OrderedDict()
        self.dropped = 0

    def __len__(self) -> int:
        return len(self._partials)

    @property
    def held_bytes(self) -> int:
        return sum(len(data) for partial in self._partials.values() for data in partial.parts.values())

    def receive(self, boot_tag: bytes, part: Part, now: float) -> tuple[Part, bytes] | None:
        """The first part and the joined data, once all parts are here."""
        if part.parts == 1:
            return part, part.data
        key = boot_tag, part.message
        partial = self._partials.get(key)
        if partial is None or partial.count != part.parts:
            self._partials.pop(key, None)
            self._make_room(boot_tag)
            partial = self._partials[key] = Partial(part.parts)
        partial.parts[part.position] = part.data
        partial.changed_at = now
        if part.position == 0:
            partial.first = part
        if len(partial.parts) < partial.count or partial.first is None:
            return None
        del self._partials[key]
        return partial.first, b"".join(partial.parts[index] for index in range(partial.count))

    def _make_room(self, boot_tag: bytes) -> None:
        own = [key for key in self._partials if key[0] == boot_tag]
        if len(own) >= MAX_PARTIALS_PER_SENDER:
            del self._partials[own[0]]
            self.dropped += 1
        elif len(self._partials) >= MAX_PARTIALS:
            self._partials.popitem(last=False)
            self.dropped += 1

    def arrived(self, boot_tag: bytes, message: int) -> int:
        """Bits of the parts that are here of an unfinished message."""
        partial = self._partials.get((boot_tag, message))
        return 0 if partial is None else partial.bitmap

    def expire(self, now: float) -> None:
        """Drop what has not grown for long."""
        for key, partial in list(self._partials.items()):
            if now - partial.changed_at > PARTIAL_S:
                del self._partials[key]
                self.dropped += 1

    def forget(self, boot_tag: bytes) -> None:
        """The boot is gone."""
        for key in [key for key in self._partials if key[0] == boot_tag]:
            del self._partials[key]
