"""The published vectors are what this code writes and reads."""

import json

import pytest

from tests.udp_mesh.wire.make_vectors import COMPACT_FRAMES, FOLDER, FRAMES, LEGACY, MAKERS, MESH_DATA
from udp_mesh.crypto import Key, ReceiveChannel, check_long
from udp_mesh.wire.codec import decode
from udp_mesh.wire.header import LongHeader, parse_header
from udp_mesh.wire.legacy import decode_legacy, decode_mesh_data


@pytest.mark.parametrize("name", MAKERS)
def test_published_vectors_match_the_generated_ones(name: str) -> None:
    assert json.loads((FOLDER / name).read_text()) == MAKERS[name]()


@pytest.mark.parametrize("name", FRAMES | COMPACT_FRAMES)
def test_published_bytes_decode_to_their_frames(name: str) -> None:
    vectors = json.loads((FOLDER / "frames.json").read_text())
    assert decode(bytes.fromhex(vectors[name]["hex"])) == (FRAMES | COMPACT_FRAMES)[name]


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


def test_published_legacy_bytes_decode() -> None:
    vectors = json.loads((FOLDER / "legacy.json").read_text())
    for name, datagram in LEGACY.items():
        assert decode_legacy(bytes.fromhex(vectors["datagrams"][name]["hex"])) == datagram
    assert decode_mesh_data(bytes.fromhex(vectors["message"]["hex"])) == MESH_DATA
