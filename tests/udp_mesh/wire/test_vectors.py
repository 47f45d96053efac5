"""The published vectors are what this code writes and reads."""

import hmac
import json

import pytest

from tests.udp_mesh.wire.make_vectors import (
    ALICE,
    BOB,
    COMPACT_FRAMES,
    FOLDER,
    FRAMES,
    LEGACY,
    MAKERS,
    MESH_DATA,
    RELAY_FRAMES,
)
from tests.udp_mesh.wire.newer_vectors import NEWER, NUMBERED
from udp_mesh.core.thin.numbering import split_number
from udp_mesh.crypto import Key, ReceiveChannel, check_long
from udp_mesh.wire.codec import decode
from udp_mesh.wire.frames import Fragment, Ping
from udp_mesh.wire.header import LongHeader, ShortHeader, parse_header
from udp_mesh.wire.legacy import decode_legacy, decode_mesh_data
from udp_mesh.wire.relay import Carry, HopAck, decode_relay


@pytest.mark.parametrize("name", MAKERS)
def test_published_vectors_match_the_generated_ones(name: str) -> None:
    assert json.loads((FOLDER / name).read_text()) == MAKERS[name]()


@pytest.mark.parametrize("name", FRAMES | COMPACT_FRAMES)
def test_published_bytes_decode_to_their_frames(name: str) -> None:
    vectors = json.loads((FOLDER / "frames.json").read_text())
    assert decode(bytes.fromhex(vectors[name]["hex"])) == (FRAMES | COMPACT_FRAMES)[name]


@pytest.mark.parametrize("name", NEWER)
def test_published_heartbeats_of_later_versions_are_read_without_what_is_new(name: str) -> None:
    vectors = json.loads((FOLDER / "newer.json").read_text())
    assert decode(bytes.fromhex(vectors[name]["hex"])) == NEWER[name].frames


@pytest.mark.parametrize("name", NUMBERED)
def test_published_numbered_messages_contain_the_number_and_the_payload(name: str) -> None:
    vector = json.loads((FOLDER / "thin.json").read_text())["numbered"][name]
    (fragment,) = decode(bytes.fromhex(vector["hex"]))
    assert isinstance(fragment, Fragment)
    assert fragment.head is not None
    assert split_number(fragment.head.flags, bytes(fragment.payload)) == NUMBERED[name]


def test_published_datagrams_open() -> None:
    for vector in json.loads((FOLDER / "sealed.json").read_text()):
        key = Key(bytes.fromhex(vector["fleet_key"]))
        boots = [bytes.fromhex(vector[name]) for name in ("sender_boot", "receiver_boot") if vector[name]]
        channel = ReceiveChannel(key, *boots)
        data = bytes.fromhex(vector["datagram"])
        header = parse_header(data)
        if isinstance(header, LongHeader):
            check_long(key, data, header)
            number, frames = channel.open_long(data, header)
        else:
            # A short header is read by a receiver that knows the channel and about where its numbers are.
            channel.window.accept(vector["packet_number"] - 1)
            assert header.tag == vector["tag"]
            number, frames = channel.open(data, header.number_low)
        assert number == vector["packet_number"]
        assert frames.hex() == vector["frames"]


@pytest.mark.parametrize("name", RELAY_FRAMES)
def test_published_relay_bytes_decode_to_their_frame(name: str) -> None:
    vectors = json.loads((FOLDER / "relay.json").read_text())
    assert decode_relay(bytes.fromhex(vectors["frames"][name]["hex"])) == RELAY_FRAMES[name]


def test_published_relay_keys_follow_from_the_formulas_of_the_page() -> None:
    """Derived here with HMAC alone."""
    vectors = json.loads((FOLDER / "relay.json").read_text())
    prk = hmac.digest(b"udp_mesh wire 1 fleet key", bytes.fromhex(vectors["fleet_key"]), "sha256")
    hop = hmac.digest(prk, b"relay hop", "sha256")
    hop_prk = hmac.digest(b"udp_mesh wire 1 fleet key", hop, "sha256")
    assert vectors["hop_key"] == hop.hex()
    assert vectors["hop_key_id"] == hmac.digest(hop_prk, b"key id", "sha256")[:4].hex()
    for boot, proof in vectors["proofs"].items():
        assert proof == hmac.digest(prk, b"relay member" + bytes.fromhex(boot), "sha256")[:8].hex()


def test_published_relay_datagrams_open_under_the_hop_key_and_the_carried_one_at_its_end() -> None:
    vectors = json.loads((FOLDER / "relay.json").read_text())
    hop, fleet = (Key(bytes.fromhex(vectors[name])) for name in ("hop_key", "fleet_key"))
    opened = {}
    for title, vector in vectors["datagrams"].items():
        data = bytes.fromhex(vector["datagram"])
        boots = [bytes.fromhex(vector[name]) for name in ("sender_boot", "receiver_boot") if vector[name]]
        assert data[0] == 0x94
        header = parse_header(data[1:])
        channel = ReceiveChannel(hop, *boots)
        if isinstance(header, LongHeader):
            check_long(hop, data[1:], header)
            number, frame = channel.open_long(data[1:], header)
        else:
            number, frame = channel.open(data[1:], header.number_low)
        assert (number, frame.hex()) == (vector["packet_number"], vector["frame"])
        opened[title] = decode_relay(frame)
    assert opened["hello"] == RELAY_FRAMES["hello of a relay"]
    assert opened["acknowledgement"] == HopAck(0, 8000)
    carry = opened["carried datagram"]
    assert isinstance(carry, Carry)
    assert (carry.origin, carry.destination) == (ALICE[:8], BOB[:8])
    header = parse_header(carry.datagram)
    assert isinstance(header, ShortHeader)
    _, frames = ReceiveChannel(fleet, ALICE, BOB).open(carry.datagram, header.number_low)
    assert decode(frames) == [Ping(7)]


def test_published_legacy_bytes_decode() -> None:
    vectors = json.loads((FOLDER / "legacy.json").read_text())
    for name, datagram in LEGACY.items():
        assert decode_legacy(bytes.fromhex(vectors["datagrams"][name]["hex"])) == datagram
    assert decode_mesh_data(bytes.fromhex(vectors["message"]["hex"])) == MESH_DATA
