"""The settings of thin links: this node's number, and each link's rate, frame size and limits of its radio band."""

from __future__ import annotations

import math
from dataclasses import dataclass

from udp_mesh.wire.limits import MAX_THIN_FRAME_BYTES, MAX_THIN_NUMBER
from udp_mesh.wire.thin import (
    HEARD_BYTES,
    INTRODUCTION_BYTES,
    PRESENCE_BYTES,
    THIN_OVERHEAD_BYTES,
    topic_hash,
)

MIN_FRAME_BYTES = 40
"""Room for a presence with a name of 12 bytes and one node that is heard."""

BURST_SHARE = 0.25
"""Part of a window's airtime that may be used at once; the rest comes evenly in the course of the window."""
URGENT_SHARE = 0.25
"""Part of all airtime that only urgent messages use, so that an emergency stop does not wait behind others."""

MIN_PRESENCE_S, MAX_PRESENCE_S = 1.0, 170.0
"""The interval has one byte on the wire, and varies by half."""


@dataclass(frozen=True, slots=True)
class ThinLinkSettings:
    """One thin link. A frame of n bytes occupies the channel for `frame_s` + 8 (n + `frame_overhead_bytes`) /
    `bits_per_s`. In any `window_s` the node sends for at most `duty_cycle` of the time (1: no limit). A frame
    occupies the channel for at most `max_airtime_s` (None: no limit)."""

    name: str
    bits_per_s: float
    frame_bytes: int = 200
    frame_overhead_bytes: int = 0
    frame_s: float = 0.0
    duty_cycle: float = 1.0
    window_s: float = 3600.0
    max_airtime_s: float | None = None

    def __post_init__(self) -> None:
        if not self.name.isprintable() or not self.name or any(map(str.isspace, self.name)):
            raise ValueError(f"thin link {self.name!r}: expected a name without white space")
        for key in ("bits_per_s", "window_s"):
            if not 0 < getattr(self, key) < math.inf:
                raise ValueError(f"thin link {self.name}: expected a positive {key}, found {getattr(self, key)}")
        if not MIN_FRAME_BYTES <= self.frame_bytes <= MAX_THIN_FRAME_BYTES:
            raise ValueError(
                f"thin link {self.name}: expected frame_bytes of {MIN_FRAME_BYTES} to {MAX_THIN_FRAME_BYTES}, "
                f"found {self.frame_bytes}"
            )
        if not 0 < self.duty_cycle <= 1:
            raise ValueError(f"thin link {self.name}: expected a duty_cycle above 0 up to 1, found {self.duty_cycle}")
        if self.max_airtime_s is not None and self.airtime_s(MIN_FRAME_BYTES) > self.max_airtime_s:
            raise ValueError(
                f"thin link {self.name}: expected max_airtime_s of at least {self.airtime_s(MIN_FRAME_BYTES):.3f} "
                f"for a frame of {MIN_FRAME_BYTES} bytes at this rate, found {self.max_airtime_s}"
            )
        room_s = (1 - URGENT_SHARE) * self.burst_s
        if self.duty_cycle < 1 and self.airtime_s(self.largest_frame_bytes) > room_s:
            raise ValueError(
                f"thin link {self.name}: expected frames of at most {room_s:.3f} s for this duty_cycle, "
                f"found {self.airtime_s(self.largest_frame_bytes):.3f} s"
            )

    def airtime_s(self, frame_bytes: int) -> float:
        """How long a frame of this size occupies the channel."""
        return self.frame_s + 8 * (frame_bytes + self.frame_overhead_bytes) / self.bits_per_s

    @property
    def burst_s(self) -> float:
        """Airtime that may be used at once."""
        return BURST_SHARE * self.duty_cycle * self.window_s

    @property
    def largest_frame_bytes(self) -> int:
        """The largest frame that is sent: as large as the link and `max_airtime_s` allow."""
        if self.max_airtime_s is None:
            return self.frame_bytes
        room_s = self.max_airtime_s - self.frame_s
        # The small addend keeps 0.4 s at a whole number of bytes from losing one to rounding.
        most = int(room_s * self.bits_per_s / 8 + 1e-9) - self.frame_overhead_bytes
        return min(self.frame_bytes, most)


@dataclass(frozen=True, slots=True)
class ThinSettings:
    """`number` is this node's, different from every other's on these links. Presence is sent about every
    `presence_s`, on other frames where they have room."""

    number: int | None = None
    links: tuple[ThinLinkSettings, ...] = ()
    presence_s: float = 45.0

    def __post_init__(self) -> None:
        if self.links and self.number is None:
            raise ValueError("thin.number: expected this node's number on thin links, found none")
        if self.number is not None and not 1 <= self.number <= MAX_THIN_NUMBER:
            raise ValueError(f"thin.number: expected 1 to {MAX_THIN_NUMBER}, found {self.number}")
        if not MIN_PRESENCE_S <= self.presence_s <= MAX_PRESENCE_S:
            raise ValueError(
                f"thin.presence_s: expected {MIN_PRESENCE_S:g} to {MAX_PRESENCE_S:g}, found {self.presence_s}"
            )
        names = [link.name for link in self.links]
        if len(set(names)) != len(names):
            raise ValueError(f"thin.links: expected each name once, found {', '.join(names)}")


def check_thin(name: str, topics: list[str], links: tuple[ThinLinkSettings, ...]) -> None:
    """Raises ValueError if a node of this name with these topics cannot use these links."""
    _check_topics(topics)
    _check_presence(name, links)


def _check_presence(name: str, links: tuple[ThinLinkSettings, ...]) -> None:
    """Raises ValueError if a presence with this name and one node that is heard does not fit a link's frames: the node
    could not introduce itself."""
    needed = THIN_OVERHEAD_BYTES + INTRODUCTION_BYTES + PRESENCE_BYTES + len(name.encode()) + HEARD_BYTES
    for link in links:
        if link.largest_frame_bytes < needed:
            raise ValueError(
                f"name: expected a name of at most {len(name.encode()) - needed + link.largest_frame_bytes} bytes, "
                f"because frames of thin link {link.name} have {link.largest_frame_bytes} bytes, found {name}"
            )


def _check_topics(names: list[str]) -> None:
    """Raises ValueError if two topics on thin links have the same hash on the wire."""
    hashes: dict[bytes, str] = {}
    for name in names:
        other = hashes.setdefault(topic_hash(name), name)
        if other != name:
            raise ValueError(f"topics: expected another name for {name}, found one with the hash of {other}")
