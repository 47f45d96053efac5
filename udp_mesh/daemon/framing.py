"""A client's byte stream -> its requests and malformed frames (docs/local-api.md, "Frames").

A malformed frame costs only itself: its lengths say where the next one begins, so an oversized frame is skipped without
being stored and the connection continues.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from math import isfinite
from typing import NamedTuple

from udp_mesh.client.mesh_client import MAX_HEADER_BYTES, Frame, Header, MeshError, parse_header

_LENGTHS = struct.Struct(">II")


class BadFrame(NamedTuple):
    """A frame that is not a valid request: the id to answer (None: no id, or unreadable), and the reason."""

    request_id: int | float | str | None
    code: str
    text: str


class RequestReader:
    """The reading half of one connection. Buffers at most one frame within the limits."""

    def __init__(self, max_payload_bytes: Callable[[], int]) -> None:
        """`max_payload_bytes` is called for each frame: the limit may change while the daemon runs."""
        self._buffer = bytearray()
        self._needed = _LENGTHS.size
        """Bytes from the start of the first frame that must be buffered before it is parsed again."""
        self._skip_bytes = 0
        """Bytes of a refused frame that are still to be skipped."""
        self._max_payload_bytes = max_payload_bytes

    def feed(self, data: bytes) -> list[Frame | BadFrame]:
        """Returns the frames that these bytes complete, in order."""
        if self._skip_bytes:
            count = min(self._skip_bytes, len(data))
            self._skip_bytes -= count
            data = data[count:]
        buffer = self._buffer
        buffer += data
        found: list[Frame | BadFrame] = []
        start = 0
        while len(buffer) - start >= self._needed:
            head_bytes, payload_bytes = _LENGTHS.unpack_from(buffer, start)
            body = start + _LENGTHS.size
            payload = body + head_bytes
            end = payload + payload_bytes
            max_bytes = self._max_payload_bytes()
            if head_bytes > MAX_HEADER_BYTES:
                expected = f"a header of at most {MAX_HEADER_BYTES} bytes"
                found.append(BadFrame(None, "bad-frame", f"expected {expected}, found {head_bytes}"))
            elif payload_bytes > max_bytes:
                if len(buffer) < payload:
                    self._needed = payload - start
                    break
                text = f"expected a payload of at most {max_bytes} bytes, found {payload_bytes}"
                found.append(_refused(bytes(buffer[body:payload]), "too-large", text))
            elif len(buffer) < end:
                self._needed = end - start
                break
            else:
                found.append(_parsed(bytes(buffer[body:payload]), bytes(memoryview(buffer)[payload:end])))
            self._needed = _LENGTHS.size
            self._skip_bytes = max(0, end - len(buffer))
            start = min(end, len(buffer))
        del buffer[:start]
        return found

    @property
    def buffered_bytes(self) -> int:
        """Bytes of the incomplete frame."""
        return len(self._buffer)

    def discard_partial(self, code: str, text: str) -> BadFrame:
        """Drops the incomplete frame and skips the rest of it. Requires its first eight bytes."""
        buffer = self._buffer
        head_bytes, payload_bytes = _LENGTHS.unpack_from(buffer)
        payload = _LENGTHS.size + head_bytes
        refused = (
            _refused(bytes(buffer[_LENGTHS.size : payload]), code, text)
            if len(buffer) >= payload
            else BadFrame(None, code, text)
        )
        self._skip_bytes = payload + payload_bytes - len(buffer)
        self._needed = _LENGTHS.size
        buffer.clear()
        return refused


def _parsed(head: bytes, payload: bytes) -> Frame | BadFrame:
    try:
        return _header(head), payload
    except MeshError as error:
        return BadFrame(None, error.code, str(error))


def _refused(head: bytes, code: str, text: str) -> BadFrame:
    """A frame whose payload is refused; its header holds the id to answer."""
    try:
        return BadFrame(_header(head).get("id"), code, text)
    except MeshError as error:
        return BadFrame(None, error.code, str(error))


def _header(raw: bytes) -> Header:
    """Like `parse_header`, but also checks that the id can be sent back."""
    header = parse_header(raw)
    request_id = header.get("id")
    # JSON has no NaN and Infinity, so these cannot be sent back.
    is_odd = isinstance(request_id, bool) or (isinstance(request_id, float) and not isfinite(request_id))
    if is_odd or not isinstance(request_id, int | float | str | None):
        raise MeshError("bad-frame", "id: expected a number or a string, found another value")
    return header
