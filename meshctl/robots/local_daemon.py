"""The udp_mesh daemon of this machine, over its local socket: one request, one reply (docs/local-api.md).

`LocalDaemon` connects when it is first used and again after an error, so that a daemon may be restarted.
"""

from __future__ import annotations

import json
import os
import socket
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

DEFAULT_SOCKET = Path("/run/udp-mesh/udp-mesh.sock")
MAX_REPLY_BYTES = 64 << 20
TIMEOUT_S = 2.0
_LENGTHS = struct.Struct(">II")


class DaemonError(Exception):
    """The daemon cannot be reached (empty `code`), or refused the request."""

    def __init__(self, text: str, code: str = "") -> None:
        super().__init__(text)
        self.code = code


def socket_path(given: Path | None, environ: Mapping[str, str] = os.environ) -> Path:
    """The option's path, or UDP_MESH_SOCKET, or the default."""
    return given or Path(environ.get("UDP_MESH_SOCKET") or DEFAULT_SOCKET)


@dataclass(slots=True)
class LocalDaemon:
    """The daemon behind `path`. Not thread-safe."""

    path: Path
    _connection: socket.socket | None = field(default=None, repr=False)

    def request(self, op: str, payload: bytes = b"", **fields: object) -> dict[str, Any]:
        """The reply's header. Raises DaemonError."""
        try:
            return self._request(op, payload, fields)
        except (OSError, ValueError) as error:
            self.close()
            reason = error.strerror if isinstance(error, OSError) else None
            raise DaemonError(f"{self.path}: {reason or error}") from error

    def event(self) -> tuple[dict[str, Any], bytes] | None:
        """The next event of a subscription: its header and payload; None if none comes for a while. Raises
        DaemonError."""
        assert self._connection is not None, "subscribe first"
        try:
            try:
                first = self._connection.recv(1)
            except TimeoutError:
                return None
            if not first:
                raise ConnectionError("the daemon closed the connection")
            return self._frame(first + self._read(_LENGTHS.size - 1))
        except (OSError, ValueError) as error:
            self.close()
            reason = error.strerror if isinstance(error, OSError) else None
            raise DaemonError(f"{self.path}: {reason or error}") from error

    def _frame(self, lengths: bytes) -> tuple[dict[str, Any], bytes]:
        header_bytes, payload_bytes = _LENGTHS.unpack(lengths)
        if header_bytes + payload_bytes > MAX_REPLY_BYTES:
            raise ValueError(f"a reply of {header_bytes + payload_bytes} bytes")
        header = json.loads(self._read(header_bytes))
        payload = self._read(payload_bytes)
        if not isinstance(header, dict):
            raise ValueError("a reply that is no object")
        return header, payload

    def _request(self, op: str, payload: bytes, fields: Mapping[str, object]) -> dict[str, Any]:
        if self._connection is None:
            self._connection = socket.socket(socket.AF_UNIX)
            self._connection.settimeout(TIMEOUT_S)
            self._connection.connect(str(self.path))
        header = json.dumps({"op": op, "id": 1, **fields}).encode()
        self._connection.sendall(_LENGTHS.pack(len(header), len(payload)) + header + payload)
        # without a subscription, the reply is the next frame
        reply, _ = self._frame(self._read(_LENGTHS.size))
        if not reply.get("ok"):
            raise DaemonError(f"{self.path}: {reply.get('error', 'refused')}", str(reply.get("code", "refused")))
        return reply

    def _read(self, count: int) -> bytes:
        assert self._connection is not None
        read = bytearray()
        while len(read) < count:
            part = self._connection.recv(count - len(read))
            if not part:
                raise ConnectionError("the daemon closed the connection")
            read += part
        return bytes(read)

    def close(self) -> None:
        if self._connection is not None:
            self._connection.close()
            self._connection = None
