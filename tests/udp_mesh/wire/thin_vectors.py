"""Vectors of thin links: items, sealed frames, and the bytes of serial lines."""

from __future__ import annotations

from typing import Any

from digi.xbee.models.address import XBee16BitAddress, XBee64BitAddress
from digi.xbee.packets.common import ReceivePacket

from tests.udp_mesh.wire.newer_vectors import make_numbered
from udp_mesh.crypto import Key
from udp_mesh.crypto.thin import ThinChannel, thin_hint
from udp_mesh.wire.serial_framing import encode_line
from udp_mesh.wire.thin import (
    HeardFrom,
    Part,
    ThinAck,
    ThinBody,
    ThinItem,
    ThinPresence,
    encode_body,
    encode_header,
    encode_item,
    topic_hash,
)
from udp_mesh.wire.xbee import encode_transmit_request

THIN_KEY = Key(bytes(range(32)))
BOOT_TAG = bytes(range(8))
STOP = encode_body(ThinBody("std_msgs/msg/Bool", b"\x01"))

ITEMS: dict[str, ThinItem] = {
    "presence of a node that hears no other": ThinPresence("base", 68),
    "presence of a node that hears two": ThinPresence(
        "husky1", 68, (HeardFrom(1, b"\x11\x22\x33\x44"), HeardFrom(254, b"\xff" * 4))
    ),
    "a whole message arrived": ThinAck(1, 0xBEEF),
    "parts 0, 2 and 31 arrived": ThinAck(1, 0xBEEF, 1 | 1 << 2 | 1 << 31),
    "a message to all": Part(0xBEEF, 0, True, None, 0, 1, topic_hash("estop"), STOP),
    "the first part of a message to one": Part(7, 8, True, 3, 0, 2, topic_hash("report"), b"\x00first"),
    "its last part": Part(7, 8, True, 3, 1, 2, None, b"last"),
    "best effort": Part(8, 13, False, None, 0, 1, topic_hash("~mesh/position"), b""),
}


def _plain(value: object) -> object:
    if isinstance(value, bytes):
        return value.hex()
    if isinstance(value, tuple):
        fields = getattr(value, "_asdict", None)
        return [_plain(item) for item in value] if fields is None else {k: _plain(v) for k, v in fields().items()}
    return value


def _xbee_lines(frame: bytes, *, escaped: bool) -> dict[str, str]:
    """The line to the sender's radio, and the one from a receiver's, which adds the sender's address. Digi's library
    checks both (test_xbee.py)."""
    address = XBee64BitAddress.from_hex_string("0013A20040A1B2C3")
    packet = ReceivePacket(address, XBee16BitAddress.UNKNOWN_ADDRESS, 0x02, bytearray(frame))
    return {
        "transmit_request": encode_transmit_request(frame, escaped=escaped).hex(),
        "receive_packet": bytes(packet.output(escaped=escaped)).hex(),
    }


def thin_frame_vectors() -> list[dict[str, Any]]:
    """Sealed frames of one boot, and their lines."""
    channel = ThinChannel(THIN_KEY, BOOT_TAG, 3)
    items = b"".join(encode_item(ITEMS[name]) for name in ("presence of a node that hears two", "a message to all"))
    frames: list[dict[str, Any]] = []
    for counter, tag in ((0x00010002, BOOT_TAG), (0x00010003, None)):
        header = encode_header(thin_hint(THIN_KEY), 3, counter, tag)
        frame = channel.seal(header, items, counter)
        frames.append(
            {
                "number": 3,
                "boot_tag": BOOT_TAG.hex(),
                "counter": counter,
                "introduction": tag is not None,
                "items": items.hex(),
                "frame": frame.hex(),
                "serial_line": encode_line(frame).hex(),
                "xbee": _xbee_lines(frame, escaped=False),
                "xbee_escaped": _xbee_lines(frame, escaped=True),
            }
        )
    return frames


def make_thin() -> object:
    """Everything that another implementation needs to check itself."""
    return {
        "items": {
            name: {"kind": type(item).__name__, "item": _plain(item), "hex": encode_item(item).hex()}
            for name, item in ITEMS.items()
        },
        "body": {"type_name": "std_msgs/msg/Bool", "payload": "01", "hex": STOP.hex()},
        "topics": {name: topic_hash(name).hex() for name in ("estop", "report", "~mesh/position")},
        "fleet_key": THIN_KEY.secret.hex(),
        "hint": thin_hint(THIN_KEY),
        "frames": thin_frame_vectors(),
        "numbered": make_numbered(),
    }
