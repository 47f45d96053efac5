"""A reader that cannot run past its slice, and the text checks that all decoders share.

Big-endian integers, length-prefixed text and bytes. Every read names what it expects, for the error message. As with
dnspython's `wirebase`, a decoder built on it can only return a value or raise `DecodeError`.
"""

from __future__ import annotations

from udp_mesh.wire.errors import DecodeError


class Reader:
    """Reads one slice from front to back; a read past its end raises `DecodeError`."""

    __slots__ = ("_data", "_position", "_size")

    def __init__(self, data: bytes | bytearray | memoryview, position: int = 0) -> None:
        self._data = memoryview(data)
        self._size = len(data)
        self._position = position

    @property
    def position(self) -> int:
        return self._position

    def remaining(self) -> int:
        return self._size - self._position

    def take(self, count: int, what: str) -> memoryview:
        """The next `count` bytes as a view."""
        end = self._position + count
        if count < 0 or end > self._size:
            raise DecodeError(f"{what}: expected {count} bytes, found {self.remaining()}")
        view = self._data[self._position : end]
        self._position = end
        return view

    def integer(self, width_bytes: int, what: str) -> int:
        """The next unsigned big-endian integer."""
        end = self._position + width_bytes
        if end > self._size:
            raise DecodeError(f"{what}: expected {width_bytes} bytes, found {self.remaining()}")
        value = int.from_bytes(self._data[self._position : end], "big")
        self._position = end
        return value

    def at_most(self, width_bytes: int, limit: int, what: str) -> int:
        """An integer that may not exceed `limit`."""
        value = self.integer(width_bytes, what)
        if value > limit:
            raise DecodeError(f"{what}: expected at most {limit}, found {value}")
        return value

    def text(self, limit_bytes: int, what: str) -> str:
        """UTF-8 text after a length byte, without control characters."""
        raw = self.take(self.at_most(1, limit_bytes, f"length of {what}"), what)
        return decode_text(bytes(raw), what)

    def name(self, limit_bytes: int, what: str) -> str:
        """Text used as a name: not empty, no white space."""
        value = self.text(limit_bytes, what)
        if not value or any(character.isspace() for character in value):
            raise DecodeError(f"{what}: expected a name without white space, found {value!r}")
        return value


def decode_text(raw: bytes, what: str) -> str:
    """UTF-8 without control characters; raises DecodeError."""
    try:
        value = raw.decode("utf-8")
    except UnicodeDecodeError as error:
        raise DecodeError(f"{what}: expected UTF-8, found {raw[:40]!r}") from error
    if not value.isprintable():
        raise DecodeError(f"{what}: expected printable text, found {value[:40]!r}")
    return value


def encode_text(value: str, limit_bytes: int, what: str) -> bytes:
    """The inverse of `Reader.text`. Raises ValueError if the text is too long (a mistake of the caller)."""
    raw = value.encode("utf-8")
    if len(raw) > limit_bytes:
        raise ValueError(f"{what}: expected at most {limit_bytes} bytes of UTF-8, found {len(raw)}")
    return bytes((len(raw),)) + raw
