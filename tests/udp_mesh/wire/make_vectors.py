"""Write the wire vectors: `python -m tests.udp_mesh.wire.make_vectors`. The tests compare the files with its output.

Other implementations read `vectors/*.json`: frames as JSON with their bytes in hexadecimal, sealed datagrams with the
keys and boot ids that open them, the same of relays and thin links, versions with their bases, and datagrams and
messages of the legacy format.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from tests.udp_mesh.wire.log_vectors import make_logs
from tests.udp_mesh.wire.newer_vectors import NEWER
from tests.udp_mesh.wire.subscription_vectors import make_subscriptions
from tests.udp_mesh.wire.thin_vectors import make_thin
from udp_mesh.core.relaying.hop_channel import HopChannels, hop_key, membership_proof
from udp_mesh.crypto import Key, SendChannel
from udp_mesh.wire.codec import encode
from udp_mesh.wire.frames import (
    Ack,
    Bye,
    Cancel,
    Delivered,
    Feature,
    Fragment,
    Frame,
    Heartbeat,
    MessageFlag,
    MessageHead,
    Nack,
    Ping,
    Pong,
    Refused,
    RefuseReason,
    Sent,
    TopicAnnounce,
    Waiting,
)
from udp_mesh.wire.legacy import (
    Host,
    LegacyAck,
    LegacyDatagram,
    LegacyPayload,
    PriorityMeshData,
    encapsulate,
    encode_legacy,
    encode_mesh_data,
)
from udp_mesh.wire.relay import (
    UNREACHABLE,
    Carry,
    HeardHop,
    HopAck,
    RelayedNode,
    RelayFrame,
    RelayHello,
    encode_carry,
    encode_hello,
    encode_hop_ack,
)
from udp_mesh.wire.version import NO_BASE, VersionHeader, base_of, encode_version, version_hash

FOLDER = Path(__file__).parent / "vectors"

VERSION, PACKED = MessageFlag.VERSION, MessageFlag.VERSION | MessageFlag.COMPRESSED | MessageFlag.ZSTD

OLD_GRID = b"".join(b"%02d;" % (cell * 7 % 100) for cell in range(64))
GRID = OLD_GRID.replace(b"35;", b"wall;") + b"99;"

# Compressors differ, and so do versions of one: other bytes may decompress to the same content.
PACKED_GRID = (
    "28b52ffd20c0dd020002cc1509c03d204992100638275796b860c2d189df0df7d856b716ba66ce21537c30c0d38d97cb5d36eda889be19e6912d"
    "6e2c7075f6e0749f0df6d4469796b964ca11137c1dfa70bb7b8b5d35eba0693e19e4890d2e2cbd381900"
)
GRID_DIFFERENCE = "28b52ffd20c58d00003877616c6c39393b0200aca25134ec0c10"
# Made with the content size left out of the frame.
GRID_WITHOUT_SIZE = (
    "28b52ffd0058dd020002cc1509c03d204992100638275796b860c2d189df0df7d856b716ba66ce21537c30c0d38d97cb5d36eda889be19e6912d"
    "6e2c7075f6e0749f0df6d4469796b964ca11137c1dfa70bb7b8b5d35eba0693e19e4890d2e2cbd381900"
)


class VersionVector(NamedTuple):
    """A version, the one it is a difference to, and its bytes in the message."""

    payload: bytes
    base: bytes | None
    flags: int
    body: bytes


def version(payload: bytes, base: bytes | None = None, packed: str = "") -> VersionVector:
    """A version sent as it is, or as these compressed bytes (hexadecimal)."""
    header = VersionHeader(NO_BASE if base is None else base_of(version_hash(base)), version_hash(payload))
    body = encode_version(header, bytes.fromhex(packed) if packed else payload)
    return VersionVector(payload, base, PACKED if packed else VERSION, body)


VERSIONS: dict[str, VersionVector] = {
    "empty version": version(b""),
    "whole version": version(OLD_GRID),
    "whole version, compressed": version(OLD_GRID, packed=PACKED_GRID),
    "difference": version(GRID, OLD_GRID, GRID_DIFFERENCE),
}

REFUSED_VERSIONS: dict[str, tuple[VersionVector, RefuseReason]] = {
    "shorter than its header": (VersionVector(b"", None, VERSION, bytes(11)), RefuseReason.CORRUPT),
    "another hash": (VersionVector(b"", None, VERSION, version(b"").body + b"!"), RefuseReason.CORRUPT),
    "compressed with zlib": (
        version(OLD_GRID)._replace(flags=VERSION | MessageFlag.COMPRESSED),
        RefuseReason.CORRUPT,
    ),
    "compressed without its size": (version(OLD_GRID, packed=GRID_WITHOUT_SIZE), RefuseReason.CORRUPT),
    "difference to a version that the receiver does not have": (
        version(GRID, GRID, GRID_DIFFERENCE)._replace(base=OLD_GRID),
        RefuseReason.FORGOTTEN,
    ),
    "difference with another hash": (
        version(OLD_GRID, OLD_GRID, GRID_DIFFERENCE),
        RefuseReason.FORGOTTEN,
    ),
}
"""The receiver has `base`, and answers REFUSED with the reason."""

FRAMES: dict[str, list[Frame]] = {
    "heartbeat": [
        Heartbeat(
            "ugv1", 1, 1, 3, 1000, 4, 125_000, 77, 5, (b"peerone!", b"peertwo!"), (Waiting(0, 12), Waiting(8, 900))
        )
    ],
    "heartbeat of a node alone": [Heartbeat("basestation", 1, 1, 0, 3000, 0, 0, 0, 0)],
    "whole message in one fragment": [Fragment(1, 0, b"hello", MessageHead(5, 1, 2, 0, 1, 40), ack_now=True)],
    "empty message": [Fragment(2, 0, b"", MessageHead(0, 1, 2, 8, 0))],
    "later fragment": [Fragment(0xFFFFFFFE, 300, b"payload")],
    "fragment past position 65,535": [Fragment(3, 70_000, b"payload")],
    "repair of a broadcast": [Fragment(9, 4, b"again", broadcast_id=True)],
    "announce and first fragment": [
        TopicAnnounce(2, "map/diff", "mesh_msgs/MapDiff"),
        Fragment(4, 0, b"begin", MessageHead(12, 2, 2, 6, 3)),
    ],
    "fragment followed by an acknowledgement": [Fragment(4, 1, b"the end"), Ack(41, (1 << 41) - 1, 250, 0)],
    "acknowledgement with gaps": [Ack(1000, (1 << 256) - 1 - 0b101000, 2500, 1_250_000, (Waiting(1, 30),))],
    "delivered": [Delivered((4, 5)), Delivered((7,), broadcast_ids=True)],
    "refused": [Refused(6, RefuseReason.TOO_LARGE)],
    "cancel": [Cancel((8, 9, 10))],
    "nack of pieces and of all": [Nack(11, ((0, 2), (9, 1))), Nack(12)],
    "ping and pong": [Ping(0x0102030405060708), Pong(0x0102030405060708, 1500)],
    "bye": [Bye("shutting down")],
    "heartbeat with its sender's clock": [Heartbeat("ugv1", 1, 1, 7, 1000, 0, 0, 9, 0, clock_ms=0xFFFFFFF0)],
    "heartbeat with the clocks of heard boots": [
        Heartbeat("ugv1", 1, 1, 7, 1000, 0, 0, 9, 0, (b"peerone!", b"peertwo!"), (), 0x01020304, (0x0A0B0C, 0xFFFFFF))
    ],
    "dated message with a remaining life": [
        Sent(0x01020304),
        Fragment(1, 0, b"hello", MessageHead(5, 1, 2, 0, 1, 40, 1500), ack_now=True),
    ],
    "heartbeat of a node that keeps versions": [
        Heartbeat("ugv1", 1, 1, Feature.ZLIB | Feature.ZSTD | Feature.VERSIONS, 1000, 0, 0, 9, 0)
    ],
    "difference in one fragment": [
        TopicAnnounce(3, "grid", "nav_msgs/OccupancyGrid"),
        Fragment(
            13,
            0,
            VERSIONS["difference"].body,
            MessageHead(len(VERSIONS["difference"].body), 1, 3, 7, MessageFlag.RELIABLE | PACKED),
        ),
    ],
    "refused because its base is not held": [Refused(13, RefuseReason.FORGOTTEN)],
}

COMPACT_FRAMES: dict[str, list[Frame]] = {
    "compact message": [Fragment(1, 0, b"hello", MessageHead(5, 1, 2, 0, 1, 40), ack_now=True)],
    "compact messages with a remaining life, and one without": [
        Sent(0x01020304),
        Fragment(1, 0, b"hello", MessageHead(5, 1, 2, 6, 1, 40, 1500)),
        Fragment(2, 0, b"", MessageHead(0, 1, 3, 15, 0, 0xFFFF)),
    ],
    "a message too old to be compact": [Fragment(3, 0, b"hello", MessageHead(5, 1, 2, 0, 1, 0x10000))],
}
"""For receivers that announce COMPACT."""

FLEET_KEY, ALICE, RELAY, BOB = Key(bytes(range(32))), bytes(range(16)), bytes(range(50, 66)), bytes(range(100, 116))
"""Boots of two nodes, and of the relay between them."""

RELAY_FRAMES: dict[str, RelayFrame] = {
    "hello of a node that hears a relay": RelayHello(
        "alice", False, 1000, 7, (membership_proof(FLEET_KEY, ALICE),), (HeardHop(RELAY[:8], 41, 255, False),)
    ),
    "hello of a relay": RelayHello(
        "husky1",
        True,
        1000,
        42,
        (membership_proof(FLEET_KEY, RELAY),),
        (HeardHop(ALICE[:8], 7, 230, True), HeardHop(BOB[:8], 0xFFFFFFFF, 0, False)),
        (
            RelayedNode(BOB, 12, 18, 1, 1500, True, "uav1", (membership_proof(FLEET_KEY, BOB),)),
            RelayedNode(bytes(range(150, 166)), 3, UNREACHABLE, 8, 576, False, "gone", ()),
        ),
    ),
    "hello of a relay without the fleet key, which hears nobody": RelayHello("guest", True, 0xFFFF, 0, ()),
    "carried datagram on its first hop": Carry(3, 4, ALICE[:8], BOB[:8], (), b"\x93 any datagram"),
    "carried datagram that visited relays": Carry(
        15, 8, ALICE[:8], BOB[:8], (RELAY[:4], b"more"), b"\x93 any datagram"
    ),
    "acknowledgement of a hop": HopAck(0x1_0000_0005, 8000),
}

LEGACY: dict[str, LegacyDatagram] = {
    "host": Host("ugv1", "10.10.0.1"),
    "payload": LegacyPayload(0x7FFF, 1, 3, b"data", wants_ack=True),
    "payload to all": LegacyPayload(0x8001, 0, 1, b"data", wants_ack=False),
    "empty last fragment": LegacyPayload(5, 1, 2, b"", wants_ack=True),
    "ack": LegacyAck(0x7FFF, 1),
}

MESH_DATA = PriorityMeshData("ugv1", "std_msgs/String", 0, "status", b"\x02\x00\x00\x00ok", 7, 1_580_000_000, 5, "base")

COVERED = b"\x90 any datagram to all"


def describe(value: object) -> object:
    """JSON of a frame: its type's name and fields; bytes in hexadecimal."""
    if isinstance(value, bytes):
        return value.hex()
    if isinstance(value, tuple) and hasattr(value, "_asdict"):
        fields: Mapping[str, object] = value._asdict()
        if isinstance(value, MessageHead) and value.life_ms is None:
            # Omitted, so that files of earlier versions stay unchanged.
            fields = {name: field for name, field in fields.items() if name != "life_ms"}
        return {"type": type(value).__name__, **{name: describe(field) for name, field in fields.items()}}
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        named = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
        # Optional fields of a frame are omitted here too: files of earlier versions stay unchanged.
        said = {name: describe(field) for name, field in named.items() if field is not None}
        return {"type": type(value).__name__, **said}
    if isinstance(value, tuple | list):
        return [describe(item) for item in value]
    if isinstance(value, int) and not isinstance(value, bool):
        # Not every JSON reader can hold a bitmap of 256 bits as a number.
        return hex(value) if value >= 1 << 53 else int(value)
    return value


def make_frames() -> object:
    vectors = {name: (frames, encode(frames)) for name, frames in FRAMES.items()}
    vectors |= {name: (frames, encode(frames, compact=True)) for name, frames in COMPACT_FRAMES.items()}
    return {name: {"frames": describe(frames), "hex": encoded.hex()} for name, (frames, encoded) in vectors.items()}


def make_newer() -> object:
    """Of each the frames that a receiver of this version reads."""
    return {name: {"frames": describe(frames), "hex": encoded.hex()} for name, (frames, encoded) in NEWER.items()}


def make_sealed() -> object:
    key, sender, receiver = Key(bytes(range(32))), bytes(range(16)), bytes(range(100, 116))
    vectors = []
    for title, to, long in (
        ("hello", None, True),
        ("broadcast", None, False),
        ("introduction", receiver, True),
        ("data", receiver, False),
    ):
        channel = SendChannel(key, sender, to) if to else SendChannel(key, sender)
        channel.next_number = 0x1_0000_0005
        frames = encode([Ping(7)])
        number, data = channel.seal_long(frames) if long else channel.seal(frames)
        vectors.append(
            {
                "title": title,
                "fleet_key": key.secret.hex(),
                "key_id": key.key_id.hex(),
                "sender_boot": sender.hex(),
                "receiver_boot": to.hex() if to else None,
                "tag": channel.tag,
                "packet_number": number,
                "frames": frames.hex(),
                "datagram": data.hex(),
            }
        )
    return vectors


def make_versions() -> object:
    return {
        "accepted": {name: _version_json(vector) for name, vector in VERSIONS.items()},
        "refused": {
            name: {**_version_json(vector), "payload": None, "reason": int(reason)}
            for name, (vector, reason) in REFUSED_VERSIONS.items()
        },
    }


def _version_json(vector: VersionVector) -> dict[str, object]:
    base = None if vector.base is None else vector.base.hex()
    return {"payload": vector.payload.hex(), "base": base, "flags": int(vector.flags), "body": vector.body.hex()}


def make_legacy() -> object:
    datagrams = {
        name: {"datagram": describe(value), "hex": encode_legacy(value).hex()} for name, value in LEGACY.items()
    }
    return {
        "datagrams": datagrams,
        "message": {"message": describe(MESH_DATA), "hex": encode_mesh_data(MESH_DATA).hex()},
        "covered": {"datagram": COVERED.hex(), "hex": encapsulate(COVERED).hex()},
    }


def encode_relay(frame: RelayFrame) -> bytes:
    match frame:
        case RelayHello():
            return encode_hello(frame)
        case Carry():
            return encode_carry(frame)
        case HopAck():
            return encode_hop_ack(frame)


def make_relay() -> object:
    """Relay frames, and what a datagram from `ALICE` to `BOB` and its relay's answers look like on the first hop."""
    frames = {
        name: {"frame": describe(frame), "hex": encode_relay(frame).hex()} for name, frame in RELAY_FRAMES.items()
    }
    _, carried = SendChannel(FLEET_KEY, ALICE, BOB).seal(encode([Ping(7)]))
    relay, alice = HopChannels((FLEET_KEY,), RELAY), HopChannels((FLEET_KEY,), ALICE)
    hello = encode_relay(RELAY_FRAMES["hello of a relay"])
    carry = encode_carry(Carry(3, 4, ALICE[:8], BOB[:8], (), carried))
    ack = encode_hop_ack(HopAck(0, 8000))
    datagrams = {
        "hello": (RELAY, None, hello, relay.seal_hello(hello)),
        "carried datagram": (ALICE, RELAY, carry, alice.seal(alice.add(RELAY), carry)[1]),
        "acknowledgement": (RELAY, ALICE, ack, relay.seal(relay.add(ALICE), ack)[1]),
    }
    hop = hop_key(FLEET_KEY)
    return {
        "frames": frames,
        "fleet_key": FLEET_KEY.secret.hex(),
        "hop_key": hop.secret.hex(),
        "hop_key_id": hop.key_id.hex(),
        "proofs": {boot.hex(): membership_proof(FLEET_KEY, boot).hex() for boot in (ALICE, RELAY, BOB)},
        "datagrams": {
            title: {
                "sender_boot": sender.hex(),
                "receiver_boot": receiver.hex() if receiver else None,
                "packet_number": 0,
                "frame": frame.hex(),
                "datagram": datagram.hex(),
            }
            for title, (sender, receiver, frame, datagram) in datagrams.items()
        },
    }


MAKERS = {
    "frames.json": make_frames,
    "newer.json": make_newer,
    "sealed.json": make_sealed,
    "logs.json": make_logs,
    "subscriptions.json": make_subscriptions,
    "versions.json": make_versions,
    "relay.json": make_relay,
    "thin.json": make_thin,
    "legacy.json": make_legacy,
}


def main() -> None:
    for name, make in MAKERS.items():
        (FOLDER / name).write_text(json.dumps(make(), indent=2) + "\n")


if __name__ == "__main__":
    main()
