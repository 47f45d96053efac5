"""API frames of XBee radios on a serial line: Transmit Request to all, Receive Packet and Transmit Status.

    0x7E | length (2) | content | checksum: 0xFF less the sum of the content

With AP=2 every 0x7E, 0x7D, 0x11 and 0x13 after the first byte is escaped: 0x7D, then the byte XOR 0x20 (Digi, "XBee
Zigbee RF Module User Guide" 90002002, chapters "API operation" and "Frame descriptions"). The radio protects its frames
on the air with a CRC of its own; the checksum is about damage on the line.
"""

from __future__ import annotations

import re

from udp_mesh.wire.limits import MAX_THIN_FRAME_BYTES

START = b"\x7e"
_ESCAPED = re.compile(b"[\x7e\x7d\x11\x13]")
_ESCAPE = re.compile(b"\x7d(.?)", re.DOTALL)

TRANSMIT_REQUEST, TRANSMIT_STATUS, RECEIVE_PACKET = 0x10, 0x8B, 0x90
_FRAME_ID = 1
"""Not 0, so that the radio reports what became of a frame. Reports are not matched with frames: one number will do."""
_TO_ALL = bytes.fromhex("000000000000ffff fffe")
"""64-bit broadcast address; the 16-bit one is unknown."""
_RADIUS_AND_OPTIONS = b"\0\0"
"""As the radio's own settings say (BH or NH, TO)."""
_RECEIVE_HEADER_BYTES = 1 + 8 + 2 + 1
_STATUS_BYTES = 7
_MAX_CONTENT_BYTES = 18 + 256
"""Explicit Receive Indicator (0x91) with the largest payload of any XBee; a longer one is damage."""

AIR_OVERHEAD_BYTES = 60
"""Maximum overhead of the radio on the air: an IEEE 802.15.4 frame of 127 B has 73 B of payload with DigiMesh, and 6 B
of preamble, delimiter and length come first."""
USUAL_FRAME_BYTES = 72
"""Payload that every XBee carries, in one frame to all."""

SUCCESS, TOO_LARGE = 0x00, 0x74
_REASONS = {
    0x01: "no acknowledgment",
    0x02: "the channel is busy",
    0x15: "invalid destination",
    0x22: "it has not joined a network",
    0x31: "an error of the radio's software",
    0x32: "its buffers are full",
    TOO_LARGE: "the frame is too large for it; set frame_bytes to its NP",
}


def encode_transmit_request(frame: bytes, *, escaped: bool) -> bytes:
    """The bytes on the line that make a radio send this frame to all."""
    content = bytes((TRANSMIT_REQUEST, _FRAME_ID)) + _TO_ALL + _RADIUS_AND_OPTIONS + frame
    rest = len(content).to_bytes(2, "big") + content + bytes((0xFF - (sum(content) & 0xFF),))
    return START + (_ESCAPED.sub(lambda found: bytes((0x7D, found[0][0] ^ 0x20)), rest) if escaped else rest)


class XBeeDecoder:
    """Bytes from a radio -> frames. Holds one unfinished API frame at most; `damaged` counts starts of none.

    `refusal` says why the radio did not send a frame, until it sends one again. That frames are too large stays: it is
    the configuration, and smaller ones pass meanwhile.
    """

    def __init__(self, *, escaped: bool) -> None:
        self._escaped = escaped
        self._most_on_line = (1 + escaped) * (2 + _MAX_CONTENT_BYTES + 1)
        self._unfinished = bytearray()
        self.damaged = 0
        self.refusal: str | None = None
        self._too_large = False

    def feed(self, data: bytes) -> list[bytes]:
        """The frames that end in these bytes."""
        self._unfinished += data
        frames = []
        while (content := self._next()) is not None:
            frame = self._on_content(content)
            if frame is not None:
                frames.append(frame)
        return frames

    def _next(self) -> bytes | None:
        """The content of the next complete API frame; what cannot be one is skipped up to the next start."""
        line = self._unfinished
        while (start := line.find(START)) >= 0:
            del line[:start]
            # An escaped frame has no other start in it. Without escapes only the length tells.
            end = line.find(START, 1) if self._escaped else -1
            body = bytes(line[1 : 1 + self._most_on_line] if end < 0 else line[1:end][: self._most_on_line])
            if self._escaped:
                body = _ESCAPE.sub(lambda found: bytes((found[1][0] ^ 0x20,)) if found[1] else b"", body)
            length = int.from_bytes(body[:2], "big")
            plausible = len(body) < 2 or 1 <= length <= _MAX_CONTENT_BYTES
            complete = len(body) >= 2 + length + 1
            if plausible and not complete and end < 0:
                return None
            if plausible and complete and sum(body[2 : 2 + length + 1]) & 0xFF == 0xFF:
                # What follows an escaped frame is skipped by the search for the next start.
                del line[: 1 if self._escaped else 1 + 2 + length + 1]
                return body[2 : 2 + length]
            self.damaged += 1
            del line[:1]
        line.clear()
        return None

    def _on_content(self, content: bytes) -> bytes | None:
        if content[0] == TRANSMIT_STATUS and len(content) == _STATUS_BYTES:
            self._on_status(content[5])
        elif content[0] == RECEIVE_PACKET:
            frame = content[_RECEIVE_HEADER_BYTES:]
            if 0 < len(frame) <= MAX_THIN_FRAME_BYTES:
                return frame
            self.damaged += 1
        # Others are about the radio itself (modem status, answers to AT commands).
        return None

    def _on_status(self, status: int) -> None:
        self._too_large = self._too_large or status == TOO_LARGE
        if self._too_large:
            self.refusal = _REASONS[TOO_LARGE]
        else:
            self.refusal = None if status == SUCCESS else _REASONS.get(status, f"its delivery status is {status:#04x}")
