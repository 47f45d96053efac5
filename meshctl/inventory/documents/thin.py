"""Thin links of the fleet, and a robot's ports for them."""

from __future__ import annotations

from typing import Literal, Self

from pydantic import Field, model_validator

from meshctl.inventory.documents.base import NOT_WRITTEN, Document
from meshctl.inventory.fields import DevicePath, Name, Real, Whole, expected_error
from meshctl.model import ThinBand, ThinFraming
from meshctl.model.thin import MAX_MESHTASTIC_FRAME_BYTES


class ThinLinkDocument(Document):
    """A thin link: a slow radio on serial ports, the same on all robots that have it."""

    bits_per_s: Real = Field(default=NOT_WRITTEN, ge=10, le=1_000_000)
    """Rate on the air in bits per second. Required but with meshtastic, whose preset gives it."""
    band: ThinBand = ThinBand.NONE
    """Radio band, whose duty cycle or dwell time is kept: eu868 (868.0 to 868.6 MHz, 1 %), eu869 (869.4 to 869.65 MHz,
    10 %), us915 (902 to 928 MHz, 0.4 s), or none for a cable and 2.4 GHz."""
    framing: ThinFraming = ThinFraming.COBS
    """What is written to the serial port: cobs for cables and radios that pass bytes through, xbee for XBee radios with
    AP=1, xbee-escaped with AP=2, meshtastic for Meshtastic radios (their library must be installed on the robots)."""
    preset: Literal[
        "SHORT_TURBO",
        "SHORT_FAST",
        "SHORT_SLOW",
        "MEDIUM_FAST",
        "MEDIUM_SLOW",
        "LONG_TURBO",
        "LONG_FAST",
        "LONG_MODERATE",
        "LONG_SLOW",
    ] = "LONG_FAST"
    """Modem preset of the Meshtastic radios."""
    hop_limit: Whole = Field(default=0, ge=0, le=3)
    """How often other Meshtastic radios repeat a frame."""
    baud: Whole = Field(default=57_600, ge=50, le=4_000_000)
    """Speed between computer and radio."""
    frame_bytes: Whole = Field(default=NOT_WRITTEN, ge=40, le=255)
    """Largest frame that the radio takes: an XBee's NP, 233 of Meshtastic. Default: 200, for xbee 72."""
    frame_s: Real = Field(default=0.0, ge=0, le=10)
    """Time on the air of each frame besides its bytes, such as a preamble."""
    duty_cycle: Real = Field(default=NOT_WRITTEN, gt=0, le=1)
    """Share of each hour in which a robot may send. Default: that of the band."""

    @model_validator(mode="after")
    def _check_framing(self) -> Self:
        meshtastic = self.framing is ThinFraming.MESHTASTIC
        if meshtastic and self.model_fields_set & {"bits_per_s", "frame_s", "baud"}:
            raise expected_error("no bits_per_s, frame_s and baud with framing: meshtastic: the preset gives them")
        if meshtastic and self.frame_bytes is not None and self.frame_bytes > MAX_MESHTASTIC_FRAME_BYTES:
            raise expected_error(f"frame_bytes of at most {MAX_MESHTASTIC_FRAME_BYTES} with framing: meshtastic")
        if not meshtastic and self.bits_per_s is None:
            raise expected_error("bits_per_s, the rate on the air")
        if not meshtastic and self.model_fields_set & {"preset", "hop_limit"}:
            raise expected_error("no preset and hop_limit without framing: meshtastic")
        return self


class ThinPortsDocument(Document):
    """A robot on thin links."""

    number: Whole = Field(ge=1, le=254)
    """Its number there, different from every other robot's."""
    ports: dict[Name, DevicePath] = Field(default_factory=dict)
    """Serial port by thin link, such as /dev/serial/by-id/...."""
