"""Thin links: radios of 1 to 100 kbit/s on robots' serial ports, for a few topics when wifi is gone."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from types import MappingProxyType

WINDOW_S = 3600.0
"""Duty cycles are averaged over an hour (EN 300 220-1, 5.4)."""


class ThinBand(Enum):
    """The radio band of a thin link, whose rules limit it."""

    NONE = "none"
    EU868 = "eu868"
    EU869 = "eu869"
    US915 = "us915"

    @property
    def duty_cycle(self) -> float:
        """Greatest share of an hour in which a node may send (EN 300 220-2, annex B): 868.0 to 868.6 and 869.4 to
        869.65 MHz."""
        return {ThinBand.EU868: 0.01, ThinBand.EU869: 0.1}.get(self, 1.0)

    @property
    def dwell_s(self) -> float | None:
        """Longest time on one channel of a hopping radio: 47 CFR 15.247 (a)(1)(i), 902 to 928 MHz."""
        return 0.4 if self is ThinBand.US915 else None


class ThinFraming(Enum):
    """How frames are written to the serial port of a thin link's radio."""

    COBS = "cobs"
    XBEE = "xbee"
    XBEE_ESCAPED = "xbee-escaped"

    @property
    def overhead_bytes(self) -> int:
        """What a frame costs on the air besides its bytes: COBS and CRC; headers of an XBee at most."""
        return 6 if self is ThinFraming.COBS else 60

    @property
    def frame_bytes(self) -> int:
        """The usual largest frame."""
        return 200 if self is ThinFraming.COBS else 72


@dataclass(frozen=True, slots=True)
class ThinLink:
    """The radio of one thin link, the same on all robots. A frame of n bytes is on the air for `frame_s` +
    8 (n + `framing.overhead_bytes`) / `bits_per_s`."""

    bits_per_s: float
    band: ThinBand = ThinBand.NONE
    baud: int = 57_600
    frame_bytes: int = 200
    frame_s: float = 0.0
    duty_cycle: float | None = None
    framing: ThinFraming = ThinFraming.COBS

    @property
    def allowed_duty_cycle(self) -> float:
        """As set, else that of the band."""
        return self.band.duty_cycle if self.duty_cycle is None else self.duty_cycle

    def airtime_s(self, frame_bytes: int) -> float:
        """How long a frame occupies the channel."""
        return self.frame_s + 8 * (frame_bytes + self.framing.overhead_bytes) / self.bits_per_s

    @property
    def largest_frame_bytes(self) -> int:
        """The largest frame that the dwell time allows, at most `frame_bytes`."""
        if self.band.dwell_s is None:
            return self.frame_bytes
        room = (self.band.dwell_s - self.frame_s) * self.bits_per_s / 8
        return min(self.frame_bytes, int(room + 1e-9) - self.framing.overhead_bytes)

    @property
    def largest_message_bytes(self) -> int:
        """Type name and payload of the largest message that it carries."""
        return MAX_PARTS * (self.largest_frame_bytes - PART_OVERHEAD_BYTES)


MIN_FRAME_BYTES, MAX_FRAME_BYTES = 40, 255
MAX_2400_MHZ_FRAME_BYTES = 100
"""Payload that IEEE 802.15.4 leaves an XBee at 2.4 GHz (its NP); Zigbee and DigiMesh leave less."""
MAX_PARTS = 32
PART_OVERHEAD_BYTES = 17
"""Of a frame with one part of a message: header and tag 8, header of the part 9."""
BURST_SHARE, URGENT_SHARE = 0.25, 0.25
"""Of the allowed airtime udp_mesh sends the one at once, and keeps the other for urgent messages."""


@dataclass(frozen=True, slots=True)
class ThinPorts:
    """A robot's number on thin links, and its serial port for each of them."""

    number: int
    ports: Mapping[str, str] = field(default_factory=lambda: MappingProxyType({}))
