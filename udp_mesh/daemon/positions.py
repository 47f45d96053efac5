"""Where this node and its peers are: a small topic of the daemons' own, latest value only (docs/local-api.md).

A program or the configuration sets this node's position (`set_own`). `due` returns the message to send: two seconds
after the last one if the position moved, ten if it did not, for peers that join later. `receive` keeps each peer's last
position, with its age: ages travel instead of times, because robots' clocks differ. Pure: `now` is the core's clock.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from enum import Enum

Json = dict[str, object]

FORMAT_VERSION = 1
MOVED_PERIOD_S = 2.0
STILL_PERIOD_S = 10.0
MOVED_M = 0.5
"""A smaller change is the noise of an odometry."""
MAX_COORDINATE_M = 1e7
MAX_FRAME_BYTES = 64
MAX_POSITIONS = 1024
"""As many as peers; a holder of the key could invent names without bound."""
MAX_AGE_S = 4_000_000.0
"""46 days, which fits into a 32-bit count of milliseconds."""
DEFAULT_FRAME = "map"

_HEAD = struct.Struct(">BBIfff")
_HAS_Z = 1


class PositionSource(Enum):
    """Where a position comes from."""

    API = "api"
    CONFIGURATION = "configuration"
    PEER = "peer"


@dataclass(frozen=True, slots=True)
class Position:
    """A place in the coordinate frame `frame`; `z_m` is None if unknown. `taken_at` is on the core's clock."""

    x_m: float
    y_m: float
    z_m: float | None
    frame: str
    taken_at: float
    source: PositionSource


def is_frame(text: str) -> bool:
    """Whether this is the name of a coordinate frame: printable, without spaces."""
    return text.isprintable() and not any(map(str.isspace, text)) and 1 <= len(text.encode()) <= MAX_FRAME_BYTES


def encode(position: Position, now: float) -> bytes:
    """18 bytes and the frame's name."""
    age_ms = round(1000 * min(max(0.0, now - position.taken_at), MAX_AGE_S))
    flags = 0 if position.z_m is None else _HAS_Z
    head = _HEAD.pack(FORMAT_VERSION, flags, age_ms, position.x_m, position.y_m, position.z_m or 0.0)
    return head + position.frame.encode()


def decode(payload: bytes, now: float) -> Position | None:
    """A peer's position; None for another version and for values that are none."""
    if len(payload) < _HEAD.size or payload[0] != FORMAT_VERSION:
        return None
    _, flags, age_ms, x_m, y_m, z_m = _HEAD.unpack_from(payload)
    try:
        frame = payload[_HEAD.size :].decode()
    except UnicodeDecodeError:
        return None
    if not is_frame(frame) or not all(is_coordinate(value) for value in (x_m, y_m, z_m)):
        return None
    return Position(x_m, y_m, z_m if flags & _HAS_Z else None, frame, now - age_ms / 1000, PositionSource.PEER)


def is_coordinate(value: float) -> bool:
    """Whether this is a plausible number of meters."""
    return math.isfinite(value) and abs(value) <= MAX_COORDINATE_M


class Positions:
    """The positions of one node and its peers."""

    def __init__(self, fixed: Position | None = None) -> None:
        self.own = fixed
        self._peers: dict[str, Position] = {}
        self._sent: Position | None = None
        self._sent_at = -math.inf

    def set_own(self, position: Position) -> None:
        """A newer position of this node; an older one than the present is ignored."""
        if self.own is None or self.own.source is not position.source or position.taken_at >= self.own.taken_at:
            self.own = position

    def set_fixed(self, position: Position | None) -> None:
        """The configuration's position, or that there is none any more; a program's own position stays."""
        if position is not None or (self.own is not None and self.own.source is PositionSource.CONFIGURATION):
            self.own = position

    def due(self, now: float) -> bytes | None:
        """The message to send to all, if one is due."""
        if self.own is None:
            return None
        period_s = MOVED_PERIOD_S if _moved(self._sent, self.own) else STILL_PERIOD_S
        if now - self._sent_at < period_s:
            return None
        self._sent, self._sent_at = self.own, now
        return encode(self._current(self.own, now), now)

    def receive(self, source: str, payload: bytes, now: float) -> Position | None:
        """Keeps a peer's position and returns it; None if it is not one."""
        position = decode(payload, now)
        if position is None:
            return None
        # The one heard least recently makes room.
        self._peers.pop(source, None)
        if len(self._peers) >= MAX_POSITIONS:
            del self._peers[next(iter(self._peers))]
        self._peers[source] = position
        return position

    def json(self, name: str, now: float) -> list[Json]:
        """Every known position, this node's first."""
        own = () if self.own is None else ((name, self._current(self.own, now)),)
        return [position_json(who, position, now) for who, position in (*own, *sorted(self._peers.items()))]

    @staticmethod
    def _current(position: Position, now: float) -> Position:
        """A configured position does not age."""
        fixed = position.source is PositionSource.CONFIGURATION
        return Position(
            position.x_m,
            position.y_m,
            position.z_m,
            position.frame,
            now if fixed else position.taken_at,
            position.source,
        )


def position_json(name: str, position: Position, now: float) -> Json:
    """One position, with its age."""
    return {
        "name": name,
        "x_m": round(position.x_m, 3),
        "y_m": round(position.y_m, 3),
        "z_m": None if position.z_m is None else round(position.z_m, 3),
        "frame": position.frame,
        "age_s": round(max(0.0, now - position.taken_at), 3),
        "source": position.source.value,
    }


def _moved(before: Position | None, after: Position) -> bool:
    if before is None or before.frame != after.frame:
        return True
    old, new = (before.x_m, before.y_m, before.z_m or 0.0), (after.x_m, after.y_m, after.z_m or 0.0)
    return math.dist(old, new) > MOVED_M
