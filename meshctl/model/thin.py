"""Thin links: radios of 1 to 100 kbit/s on robots' serial ports, for a few topics where Wi-Fi does not reach."""

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
    MESHTASTIC = "meshtastic"

    @property
    def is_xbee(self) -> bool:
        return self in (ThinFraming.XBEE, ThinFraming.XBEE_ESCAPED)

    @property
    def overhead_bytes(self) -> int:
        """Overhead of a frame on the air: COBS and CRC; headers of the radio at most."""
        return 60 if self.is_xbee else 24 if self is ThinFraming.MESHTASTIC else 6

    @property
    def frame_bytes(self) -> int:
        """The usual largest frame."""
        return 72 if self.is_xbee else 200


class ThinPreset(Enum):
    """Modem presets of Meshtastic: spreading factor, bandwidth in Hz, symbols per group (5 for a code rate of 4/5)."""

    SHORT_TURBO = (7, 500e3, 5)
    SHORT_FAST = (7, 250e3, 5)
    SHORT_SLOW = (8, 250e3, 5)
    MEDIUM_FAST = (9, 250e3, 5)
    MEDIUM_SLOW = (10, 250e3, 5)
    LONG_TURBO = (11, 500e3, 8)
    LONG_FAST = (11, 250e3, 5)
    LONG_MODERATE = (11, 125e3, 8)
    LONG_SLOW = (12, 125e3, 8)

    @property
    def symbol_s(self) -> float:
        spreading, bandwidth_hz, _ = self.value
        return float(2**spreading / bandwidth_hz)

    @property
    def group_bits(self) -> int:
        """Bits of a frame in one group of symbols; symbols of 16 ms or more carry two less (Semtech AN1200.13)."""
        return 4 * (int(self.value[0]) - 2 * (self.symbol_s >= 0.016))

    @property
    def bits_per_s(self) -> float:
        """Rate on the air."""
        return float(self.group_bits / (self.value[2] * self.symbol_s))

    @property
    def frame_s(self) -> float:
        """Time on the air besides the bytes: preamble (20.25 symbols), 8 fixed symbols, header and CRC, last group."""
        spreading, _, coding = self.value
        return float(self.symbol_s * (28.25 + coding * ((44 - 4 * spreading) / self.group_bits + 1)))


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
    preset: ThinPreset | None = None
    """Of Meshtastic; `bits_per_s` and `frame_s` are then its."""
    hop_limit: int = 0
    """How often other radios of Meshtastic repeat a frame."""

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
    def longest_name_bytes(self) -> int:
        """Longest name of a robot that fits a frame beside what introduces the robot."""
        return self.largest_frame_bytes - PRESENCE_OVERHEAD_BYTES

    @property
    def largest_message_bytes(self) -> int:
        """Type name and payload of the largest message that it carries."""
        return MAX_PARTS * (self.largest_frame_bytes - PART_OVERHEAD_BYTES)


MIN_FRAME_BYTES, MAX_FRAME_BYTES = 40, 255
MAX_MESHTASTIC_FRAME_BYTES = 233
MAX_2400_MHZ_FRAME_BYTES = 100
"""Payload that IEEE 802.15.4 leaves an XBee at 2.4 GHz (its NP); Zigbee and DigiMesh leave less."""
MAX_PARTS = 32
PART_OVERHEAD_BYTES = 17
"""Of a frame with one part of a message: header and tag 8, header of the part 9."""
PRESENCE_OVERHEAD_BYTES = 28
"""Of the frame by which a robot introduces itself, besides its name, with one robot that it hears."""
BURST_SHARE, URGENT_SHARE = 0.25, 0.25
"""Of the allowed airtime udp_mesh sends the one at once, and keeps the other for urgent messages."""


@dataclass(frozen=True, slots=True)
class ThinPorts:
    """A robot's number on thin links, and its serial port for each of them."""

    number: int
    ports: Mapping[str, str] = field(default_factory=lambda: MappingProxyType({}))
