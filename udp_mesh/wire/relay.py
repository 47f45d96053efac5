"""Messages between relays and their neighbors: hellos, carried datagrams, acknowledgments of one hop.

A relay datagram is the byte `RELAY_BYTE` and a sealed datagram of kind HELLO or DATA under a relay key (`core.relaying`
derives it); what is sealed is one of the values below. A `Carry` holds a datagram that is sealed end to end, so a relay
can neither read nor change it. Nodes of earlier versions drop the first byte as an unknown kind.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

from udp_mesh.wire import limits
from udp_mesh.wire.buffer import Reader, encode_text
from udp_mesh.wire.errors import DecodeError
from udp_mesh.wire.header import MARK, VERSION
from udp_mesh.wire.limits import HEARD_TAG_BYTES

RELAY_BYTE = MARK | VERSION << 4 | 4
"""First byte of a relay datagram: kind 4."""

UNREACHABLE = 0xFFFF
"""The cost of a node that the sender no longer reaches."""

VISITED_BYTES = 4
"""Leading bytes of a relay's boot id in a carried datagram."""
PROOF_BYTES = 8

_HELLO, _CARRY, _HOP_ACK = 1, 2, 3
_CARRY_FIELDS = struct.Struct(">BB8s8sB")
CARRY_BYTES = _CARRY_FIELDS.size
"""Overhead of a `Carry` around its datagram, without the relays visited."""
_HOP_ACK_FIELDS = struct.Struct(">B6s3s")
_HELLO_FIELDS = struct.Struct(">BBHI")
_HEARD_FIELDS = struct.Struct(">8sIBB")
_NODE_FIELDS = struct.Struct(">16sIHBHB")
HELLO_FIXED_BYTES = _HELLO_FIELDS.size + 1 + limits.MAX_NAME_BYTES + 1 + limits.MAX_PROOFS * PROOF_BYTES + 2
"""A hello without its lists, at most."""
HEARD_BYTES = _HEARD_FIELDS.size


class HeardHop(NamedTuple):
    """One boot heard on the link of this hello."""

    tag: bytes
    """First 8 bytes of its boot id."""
    round: int
    """Its newest hello heard: who finds a recent one of its own here knows that this hello is no recording."""
    quality: int
    """Share of its hellos that arrived, 0 to 255."""
    passes: bool
    """The sender passes on datagrams to and from this boot, with any other end."""


class RelayedNode(NamedTuple):
    """A node that the sender of a hello reaches, and passes datagrams on to."""

    boot_id: bytes
    round: int
    """Its newest hello that this entry follows from: of two entries the one with the newer round is valid."""
    cost: int
    """Expected transmissions from the sender to it, in sixteenths; `UNREACHABLE`: no longer reached."""
    hops: int
    """Links between the sender and it."""
    mtu: int
    """Largest IP packet in bytes that every link from the sender to it carries."""
    open: bool
    """For every origin; otherwise only for those that the sender `passes`."""
    name: str
    proofs: tuple[bytes, ...]
    """Made by the node itself, one for each of its fleet keys: a holder of that key can verify it."""


@dataclass(frozen=True, slots=True)
class RelayHello:
    """To all nodes of a link, about once a second; a long one is sent in parts with the same round."""

    name: str
    relays: bool
    """The sender passes datagrams on."""
    interval_ms: int
    round: int
    """Counts the sender's hellos, whichever link they are sent on."""
    proofs: tuple[bytes, ...]
    heard: tuple[HeardHop, ...] = ()
    nodes: tuple[RelayedNode, ...] = ()


class Carry(NamedTuple):
    """A datagram on its way from `origin` to `destination` (first 8 bytes of their boot ids)."""

    priority: int
    max_hops: int
    """Links that it may use in all."""
    origin: bytes
    destination: bytes
    visited: tuple[bytes, ...]
    """First 4 bytes of the boot ids of the relays so far: one that finds itself here drops the datagram."""
    datagram: bytes | memoryview


class HopAck(NamedTuple):
    """The newest carried datagram that arrived from the receiver of this acknowledgment."""

    largest: int
    """Its packet number in the channel of this hop."""
    delay_us: int
    """From its arrival to this acknowledgment."""


RelayFrame: TypeAlias = RelayHello | Carry | HopAck


def encode_hello(hello: RelayHello) -> bytes:
    """Raises ValueError for what the format cannot carry (a mistake of the caller)."""
    if len(hello.heard) > limits.MAX_HEARD_HOPS or len(hello.nodes) > limits.MAX_RELAYED_NODES:
        raise ValueError(f"relay hello: too many entries ({len(hello.heard)} heard, {len(hello.nodes)} nodes)")
    return b"".join(
        (
            _HELLO_FIELDS.pack(_HELLO, hello.relays, hello.interval_ms, hello.round),
            encode_text(hello.name, limits.MAX_NAME_BYTES, "name"),
            _encode_proofs(hello.proofs),
            bytes((len(hello.heard),)),
            *(_HEARD_FIELDS.pack(heard.tag, heard.round, heard.quality, heard.passes) for heard in hello.heard),
            bytes((len(hello.nodes),)),
            *map(encode_node, hello.nodes),
        )
    )


def encode_node(node: RelayedNode) -> bytes:
    fields = _NODE_FIELDS.pack(node.boot_id, node.round, node.cost, node.hops, node.mtu, node.open)
    return fields + encode_text(node.name, limits.MAX_NAME_BYTES, "name") + _encode_proofs(node.proofs)


def _encode_proofs(proofs: tuple[bytes, ...]) -> bytes:
    if len(proofs) > limits.MAX_PROOFS or any(len(proof) != PROOF_BYTES for proof in proofs):
        raise ValueError(f"proofs: expected at most {limits.MAX_PROOFS} of {PROOF_BYTES} bytes, found {len(proofs)}")
    return bytes((len(proofs),)) + b"".join(proofs)


def encode_carry(carry: Carry) -> bytes:
    fields = _CARRY_FIELDS.pack(
        _CARRY, carry.priority << 4 | carry.max_hops, carry.origin, carry.destination, len(carry.visited)
    )
    return b"".join((fields, *carry.visited, carry.datagram))


def encode_hop_ack(ack: HopAck) -> bytes:
    return _HOP_ACK_FIELDS.pack(_HOP_ACK, ack.largest.to_bytes(6, "big"), ack.delay_us.to_bytes(3, "big"))


def decode_relay(data: bytes | memoryview) -> RelayFrame:
    """The frame in an opened relay datagram; a carried datagram is a view into `data`. Raises `DecodeError`."""
    reader = Reader(data)
    kind = reader.integer(1, "relay frame type")
    match kind:
        case 1:
            frame: RelayFrame = _decode_hello(reader)
        case 2:
            return _decode_carry(reader)
        case 3:
            frame = HopAck(reader.integer(6, "largest packet"), reader.integer(3, "acknowledgment delay"))
        case _:
            raise DecodeError(f"relay frame type: expected 1-3, found {kind}")
    # What follows a hello or an acknowledgment is of a later version.
    return frame


def _decode_hello(reader: Reader) -> RelayHello:
    flags = reader.integer(1, "relay flags")
    interval_ms, number = reader.integer(2, "hello interval"), reader.integer(4, "hello round")
    if not interval_ms:
        raise DecodeError("hello interval: expected at least 1 ms, found 0")
    name, proofs = _decode_name(reader), _decode_proofs(reader)
    heard = tuple(_decode_heard(reader) for _ in range(reader.at_most(1, limits.MAX_HEARD_HOPS, "heard boots")))
    nodes = tuple(_decode_node(reader) for _ in range(reader.at_most(1, limits.MAX_RELAYED_NODES, "relayed nodes")))
    return RelayHello(name, bool(flags & 1), interval_ms, number, proofs, heard, nodes)


def _decode_name(reader: Reader) -> str:
    name = reader.name(limits.MAX_NAME_BYTES, "node name")
    if "/" in name:
        raise DecodeError(f"node name: expected no slash, found {name!r}")
    return name


def _decode_proofs(reader: Reader) -> tuple[bytes, ...]:
    count = reader.at_most(1, limits.MAX_PROOFS, "number of proofs")
    return tuple(bytes(reader.take(PROOF_BYTES, "proof")) for _ in range(count))


def _decode_heard(reader: Reader) -> HeardHop:
    tag, number, quality, flags = _HEARD_FIELDS.unpack(reader.take(_HEARD_FIELDS.size, "heard boot"))
    return HeardHop(tag, number, quality, bool(flags & 1))


def _decode_node(reader: Reader) -> RelayedNode:
    boot_id, number, cost, hops, mtu, flags = _NODE_FIELDS.unpack(reader.take(_NODE_FIELDS.size, "relayed node"))
    if not 1 <= hops <= limits.MAX_RELAY_HOPS:
        raise DecodeError(f"hops: expected 1 to {limits.MAX_RELAY_HOPS}, found {hops}")
    return RelayedNode(boot_id, number, cost, hops, mtu, bool(flags & 1), _decode_name(reader), _decode_proofs(reader))


def _decode_carry(reader: Reader) -> Carry:
    levels = reader.integer(1, "priority and hops")
    priority, max_hops = levels >> 4, levels & 15
    if not 2 <= max_hops <= limits.MAX_RELAY_HOPS:
        raise DecodeError(f"hops: expected 2 to {limits.MAX_RELAY_HOPS}, found {max_hops}")
    origin = bytes(reader.take(HEARD_TAG_BYTES, "origin"))
    destination = bytes(reader.take(HEARD_TAG_BYTES, "destination"))
    count = reader.at_most(1, limits.MAX_RELAY_HOPS - 1, "relays visited")
    visited = tuple(bytes(reader.take(VISITED_BYTES, "relay")) for _ in range(count))
    return Carry(priority, max_hops, origin, destination, visited, reader.take(reader.remaining(), "datagram"))
