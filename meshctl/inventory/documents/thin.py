"""Thin links of the fleet, and a robot's ports for them."""

from __future__ import annotations

from pydantic import Field

from meshctl.inventory.documents.base import NOT_WRITTEN, Document
from meshctl.inventory.fields import Name, Real, Text, Whole
from meshctl.model import ThinBand, ThinFraming


class ThinLinkDocument(Document):
    """A thin link: a slow radio on serial ports, the same on all robots that have it."""

    bits_per_s: Real = Field(ge=10, le=1_000_000)
    """Rate on the air in bits per second."""
    band: ThinBand = ThinBand.NONE
    """Radio band, whose duty cycle or dwell time is kept: eu868 (868.0 to 868.6 MHz, 1 %), eu869 (869.4 to 869.65 MHz,
    10 %), us915 (902 to 928 MHz, 0.4 s), or none for a cable and 2.4 GHz."""
    framing: ThinFraming = ThinFraming.COBS
    """What is written to the serial port: cobs for cables and radios that pass bytes through, xbee for XBee radios with
    AP=1, xbee-escaped with AP=2."""
    baud: Whole = Field(default=57_600, ge=50, le=4_000_000)
    """Speed between computer and radio."""
    frame_bytes: Whole = Field(default=NOT_WRITTEN, ge=40, le=255)
    """Largest frame that the radio takes: an XBee's NP. Default: 200 for cobs, 72 for xbee."""
    frame_s: Real = Field(default=0.0, ge=0, le=10)
    """Time on the air of each frame besides its bytes, such as a preamble."""
    duty_cycle: Real = Field(default=NOT_WRITTEN, gt=0, le=1)
    """Share of each hour in which a robot may send. Default: that of the band."""


class ThinPortsDocument(Document):
    """A robot on thin links."""

    number: Whole = Field(ge=1, le=254)
    """Its number there, different from every other robot's."""
    ports: dict[Name, Text] = Field(default_factory=dict)
    """Serial port by thin link, such as /dev/serial/by-id/...."""
