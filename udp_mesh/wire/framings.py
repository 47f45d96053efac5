"""How frames of thin links are written to serial ports, by the name in the configuration."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from types import MappingProxyType
from typing import Protocol

from udp_mesh.wire.serial_framing import FRAMING_BYTES, LineDecoder, encode_line
from udp_mesh.wire.xbee import AIR_OVERHEAD_BYTES, USUAL_FRAME_BYTES, XBeeDecoder, encode_transmit_request


class FrameDecoder(Protocol):
    """Bytes of a line -> frames."""

    damaged: int
    refusal: str | None
    """Why the radio does not send what it gets; None if it does, or says nothing."""

    def feed(self, data: bytes) -> list[bytes]: ...


class FrameEncoder(Protocol):
    """A frame -> bytes of a line."""

    def __call__(self, frame: bytes) -> bytes: ...


@dataclass(frozen=True, slots=True)
class Framing:
    """`overhead_bytes` is what it adds to a frame on the air, `frame_bytes` the usual largest frame."""

    encode: FrameEncoder
    decoder: Callable[[], FrameDecoder]
    overhead_bytes: int
    frame_bytes: int


def _xbee(*, escaped: bool) -> Framing:
    encode = partial(encode_transmit_request, escaped=escaped)
    return Framing(encode, partial(XBeeDecoder, escaped=escaped), AIR_OVERHEAD_BYTES, USUAL_FRAME_BYTES)


TRANSPARENT = "cobs"
FRAMINGS: Mapping[str, Framing] = MappingProxyType(
    {
        TRANSPARENT: Framing(encode_line, LineDecoder, FRAMING_BYTES, 200),
        "xbee": _xbee(escaped=False),
        "xbee-escaped": _xbee(escaped=True),
    }
)
"""Transparent radios and cables; radios with AP=1 and with AP=2."""
