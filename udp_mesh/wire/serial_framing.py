"""Frames on a serial line: COBS (Cheshire and Baker, 1999) around the frame and its CRC-16, a zero byte between frames.

COBS removes zero bytes at the cost of one byte per frame (up to 254 bytes), so that a receiver that starts in the
middle, or misses bytes, is back in step at the next zero. The CRC (X.25, RFC 1662's FCS-16) finds damage before a frame
counts as a failed authentication.
"""

from __future__ import annotations

import binascii

from udp_mesh.wire.limits import MAX_THIN_FRAME_BYTES

DELIMITER = b"\0"
CRC_BYTES = 2
FRAMING_BYTES = 2 + CRC_BYTES + 2
"""Maximum overhead of a frame on the line: code bytes, CRC, delimiters."""

_MAX_ENCODED_BYTES = MAX_THIN_FRAME_BYTES + FRAMING_BYTES
_REVERSED = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))


def crc16_x25(data: bytes) -> int:
    """CRC-16/X-25: reflected polynomial 0x1021, initial value and final XOR 0xFFFF; of "123456789" it is 0x906E."""
    # `crc_hqx` has the polynomial without the reflection.
    crc = binascii.crc_hqx(data.translate(_REVERSED), 0xFFFF)
    return int(f"{crc:016b}"[::-1], 2) ^ 0xFFFF


def cobs_encode(data: bytes) -> bytes:
    """The data without zero bytes."""
    out = bytearray()
    for block in data.split(b"\0"):
        while len(block) >= 254:
            out += b"\xff" + block[:254]
            block = block[254:]
        out.append(len(block) + 1)
        out += block
    return bytes(out)


def cobs_decode(data: bytes) -> bytes | None:
    """The inverse; None if this is not the encoding of anything."""
    out = bytearray()
    at = 0
    while at < len(data):
        code = data[at]
        block = data[at + 1 : at + code]
        if code == 0 or len(block) != code - 1 or 0 in block:
            return None
        out += block
        at += code
        if code < 0xFF and at < len(data):
            out.append(0)
    return bytes(out)


def encode_line(frame: bytes) -> bytes:
    """The bytes of one frame on the line. They begin with a delimiter too, which ends whatever noise came before."""
    return DELIMITER + cobs_encode(frame + crc16_x25(frame).to_bytes(CRC_BYTES, "little")) + DELIMITER


class LineDecoder:
    """Bytes of a serial line -> frames. Holds one unfinished frame at most; `damaged` counts what was not a frame."""

    def __init__(self) -> None:
        self._unfinished = bytearray()
        self._overlong = False
        self.damaged = 0
        self.refusal: str | None = None
        """A transparent radio does not say what becomes of a frame."""

    def feed(self, data: bytes) -> list[bytes]:
        """The frames that end in these bytes."""
        frames = []
        *ended, rest = data.split(DELIMITER)
        for piece in ended:
            frame = self._end(piece)
            if frame is not None:
                frames.append(frame)
        self._add(rest)
        return frames

    def _add(self, piece: bytes) -> None:
        if len(self._unfinished) + len(piece) > _MAX_ENCODED_BYTES:
            self._overlong = True
            self._unfinished.clear()
        else:
            self._unfinished += piece

    def _end(self, piece: bytes) -> bytes | None:
        self._add(piece)
        encoded, overlong = bytes(self._unfinished), self._overlong
        self._unfinished.clear()
        self._overlong = False
        if not encoded and not overlong:
            return None
        plain = None if overlong else cobs_decode(encoded)
        if plain is None or not CRC_BYTES < len(plain) <= MAX_THIN_FRAME_BYTES + CRC_BYTES:
            self.damaged += 1
            return None
        frame, crc = plain[:-CRC_BYTES], plain[-CRC_BYTES:]
        if crc16_x25(frame) != int.from_bytes(crc, "little"):
            self.damaged += 1
            return None
        return frame
