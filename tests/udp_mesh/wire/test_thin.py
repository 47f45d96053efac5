"""Frames of thin links: what is encoded is decoded, and any bytes give items or `DecodeError`."""

from __future__ import annotations

import contextlib
import hashlib
import hmac
import json

import pytest
from cryptography.hazmat.primitives.ciphers.aead import AESCCM
from hypothesis import given
from hypothesis import strategies as st

from tests.udp_mesh.wire.make_vectors import FOLDER
from tests.udp_mesh.wire.thin_vectors import ITEMS
from udp_mesh.wire.errors import DecodeError
from udp_mesh.wire.limits import MAX_THIN_PARTS
from udp_mesh.wire.serial_framing import LineDecoder
from udp_mesh.wire.thin import (
    ACK_BYTES,
    PART_BYTES,
    PARTIAL_ACK_BYTES,
    THIN_OVERHEAD_BYTES,
    HeardFrom,
    Part,
    ThinAck,
    ThinBody,
    ThinItem,
    ThinPresence,
    decode_body,
    decode_header,
    decode_items,
    encode_body,
    encode_header,
    encode_item,
    topic_hash,
)

NUMBERS = st.integers(1, 254)
PRESENCES = st.builds(
    ThinPresence,
    st.text("abcdefghij-0123456789", min_size=1, max_size=63),
    st.integers(0, 255),
    st.lists(st.builds(HeardFrom, NUMBERS, st.binary(min_size=4, max_size=4)), max_size=48).map(tuple),
)
ACKS = st.builds(ThinAck, NUMBERS, st.integers(0, 65_535), st.none() | st.integers(0, 2**32 - 1))


@st.composite
def parts(draw: st.DrawFn) -> Part:
    many = draw(st.booleans())
    count = draw(st.integers(2, MAX_THIN_PARTS)) if many else 1
    position = draw(st.integers(0, count - 1))
    return Part(
        draw(st.integers(0, 65_535)),
        draw(st.integers(0, 15)),
        draw(st.booleans()),
        draw(st.none() | NUMBERS),
        position,
        count,
        None if position else draw(st.binary(min_size=2, max_size=2)),
        draw(st.binary(max_size=255)),
    )


@given(st.lists(PRESENCES | ACKS | parts(), max_size=8))
def test_what_is_encoded_is_decoded(items: list[ThinItem]) -> None:
    assert decode_items(b"".join(map(encode_item, items))) == items


@given(st.integers(0, 127), NUMBERS, st.integers(0, 2**32 - 1), st.none() | st.binary(min_size=8, max_size=8))
def test_headers_are_decoded(hint: int, number: int, counter: int, tag: bytes | None) -> None:
    encoded = encode_header(hint, number, counter, tag)
    header = decode_header(encoded + bytes(4))
    assert (header.hint, header.number, header.boot_tag, header.length) == (hint, number, tag, len(encoded))
    assert header.counter_low == counter & 0xFFFF
    assert header.counter_high == (None if tag is None else counter >> 16)


def test_header_and_tag_have_eight_bytes() -> None:
    assert len(encode_header(1, 2, 3, None)) + 4 == THIN_OVERHEAD_BYTES == 8


def test_items_are_as_large_as_frames_are_composed_for() -> None:
    largest = Part(1, 2, True, 3, 0, 2, b"ab", b"x" * 10)
    assert len(encode_item(largest)) == PART_BYTES + 10
    assert len(encode_item(ThinAck(1, 2))) == ACK_BYTES
    assert len(encode_item(ThinAck(1, 2, 3))) == PARTIAL_ACK_BYTES


@given(st.binary(max_size=255))
def test_any_bytes_give_items_or_a_decode_error(data: bytes) -> None:
    with contextlib.suppress(DecodeError):
        decode_header(data)
    with contextlib.suppress(DecodeError):
        decode_items(data)
    with contextlib.suppress(DecodeError):
        decode_body(data)


@given(PRESENCES | ACKS | parts(), st.integers(0, 300))
def test_a_truncated_item_is_refused(item: ThinItem, at: int) -> None:
    encoded = encode_item(item)
    if 0 < at < len(encoded):
        with pytest.raises(DecodeError):
            decode_items(encoded[:at])


@pytest.mark.parametrize(
    ("what", "data"),
    [
        ("a presence of another version", "01 02 10 01 61 00"),
        ("a name with a slash", "01 01 10 03 612f62 00"),
        ("an acknowledgment to number 0", "02 00 0001"),
        ("position 5 of 5", "90 0001 05 05 00"),
        ("33 parts", "90 0001 00 21 0000 00"),
        ("one of one, as one of many", "90 0001 00 01 0000 00"),
        ("to number 255", "a0 0001 ff 0000 00"),
        ("an unknown item", "7f"),
    ],
)
def test_items_beyond_their_caps_are_refused(what: str, data: str) -> None:
    with pytest.raises(DecodeError):
        decode_items(bytes.fromhex(data))


def test_a_body_has_its_type_and_payload() -> None:
    body = ThinBody("std_msgs/msg/Bool", b"\x01\x00")
    assert decode_body(encode_body(body)) == body
    assert decode_body(encode_body(ThinBody("", b""))) == ThinBody("", b"")


def test_topics_of_a_fleet_have_different_hashes() -> None:
    names = [f"/{robot}/{topic}" for robot in ("husky1", "spot", "uav1") for topic in ("estop", "position", "artifact")]
    assert len({topic_hash(name) for name in names}) == len(names)


@pytest.mark.parametrize("name", ITEMS)
def test_published_items_decode(name: str) -> None:
    vectors = json.loads((FOLDER / "thin.json").read_text())
    assert decode_items(bytes.fromhex(vectors["items"][name]["hex"])) == [ITEMS[name]]


def test_published_frames_open_with_the_formulas_of_the_page() -> None:
    vectors = json.loads((FOLDER / "thin.json").read_text())
    prk = hmac.digest(b"udp_mesh wire 1 fleet key", bytes.fromhex(vectors["fleet_key"]), "sha256")
    assert vectors["hint"] == hmac.digest(prk, b"thin 1 hint", "sha256")[0] & 0x7F
    for name, expected in vectors["topics"].items():
        assert hashlib.blake2b(name.encode(), digest_size=2).hexdigest() == expected
    for vector in vectors["frames"]:
        frame, tag = bytes.fromhex(vector["frame"]), bytes.fromhex(vector["boot_tag"])
        key = hmac.digest(prk, b"thin 1" + tag + b"\x01", "sha256")[:16]
        nonce = bytes((vector["number"],)) + vector["counter"].to_bytes(12, "big")
        header = 14 if vector["introduction"] else 4
        opened = AESCCM(key, tag_length=4).decrypt(nonce, frame[header:], frame[:header])
        assert opened.hex() == vector["items"]
        line = bytes.fromhex(vector["serial_line"])
        assert line[0] == line[-1] == 0
        assert LineDecoder().feed(line) == [frame]
