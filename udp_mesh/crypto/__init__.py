"""Keys and sealing: fleet key -> channel key -> sealed datagram -> opened frames, each packet once.

`keys` holds the fleet's one or two live keys, `channel` seals and opens the datagrams of one direction between two
boots (or from one boot to all), and `replay` remembers which packet numbers were seen. docs/threat-model.md describes
the attackers considered.
"""

from udp_mesh.crypto.channel import (
    LONG_OVERHEAD_BYTES,
    SHORT_OVERHEAD_BYTES,
    TO_ALL,
    OpenError,
    ReceiveChannel,
    ReplayError,
    SendChannel,
    age_together,
    check_long,
)
from udp_mesh.crypto.keys import Key, UnknownKeyError
from udp_mesh.crypto.replay import ReplayWindow

__all__ = [
    "LONG_OVERHEAD_BYTES",
    "SHORT_OVERHEAD_BYTES",
    "TO_ALL",
    "Key",
    "OpenError",
    "ReceiveChannel",
    "ReplayError",
    "ReplayWindow",
    "SendChannel",
    "UnknownKeyError",
    "age_together",
    "check_long",
]
