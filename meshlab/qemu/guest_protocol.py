"""The protocol between host and machine over one TCP port of the machine.

Each connection begins with one JSON line, `{"token": T, "kind": K, ...}`:

    request  {"request": {...}}                  the reply is one JSON line, as on a fleet's control socket
    exec     {"request": {...}, "terminal": [rows, columns] or null}
                                                 frames both ways; the machine's last one is the reply
    dial     {"host": "127.42.0.11"}             one JSON line, then the bytes of the connection to that port
    watch    {}                                  a JSON line {"doors": {host: node}} with the forwarded ports, at every
                                                 change

A frame is a stream number (0 input or reply, 1 output, 2 errors), a length, and that many bytes.
"""

from __future__ import annotations

import json
import struct
from typing import Any

# the machine's address on QEMU's user network: TEST-NET-1 (RFC 5737), which no fleet uses
ADDRESS = "192.0.2.15"
GATEWAY = "192.0.2.2"
NETWORK = "192.0.2.0/24"
PORT = 7000
# printed on the console when the supervisor listens
READY = "lab: ready"

# the maximum sizes of a frame and a line: replies of big fleets have a few hundred bytes per node
FRAME_BYTES = 1 << 16
LINE_BYTES = 1 << 20
_HEADER = struct.Struct("!BI")
HEADER_BYTES = _HEADER.size

ANSWER = 0
INPUT = 0
OUTPUT = 1
ERRORS = 2


def line(message: dict[str, Any]) -> bytes:
    return json.dumps(message).encode() + b"\n"


def frame(stream: int, content: bytes) -> bytes:
    """One frame. An empty one ends the input."""
    if len(content) > LINE_BYTES:
        raise ValueError(f"a frame holds at most {LINE_BYTES} bytes")
    return _HEADER.pack(stream, len(content)) + content


def header(content: bytes) -> tuple[int, int]:
    """Stream and length of the frame that begins with these `HEADER_BYTES`."""
    stream, length = _HEADER.unpack(content)
    return int(stream), int(length)
