"""The published vectors of shared logs: what they accept and refuse, also read as another implementation would."""

from __future__ import annotations

import json
import struct

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from tests.udp_mesh.wire.log_vectors import CONTROL, ITEMS, REFUSED_CONTROL, refused_items
from tests.udp_mesh.wire.make_vectors import FOLDER
from udp_mesh.core.logs.item import decode_item
from udp_mesh.core.logs.messages import decode_control
from udp_mesh.wire.errors import DecodeError

PUBLISHED = json.loads((FOLDER / "logs.json").read_text())


@pytest.mark.parametrize("name", CONTROL)
def test_published_control_messages_decode(name: str) -> None:
    assert decode_control(bytes.fromhex(PUBLISHED["control"][name]["hex"])) == CONTROL[name]


@pytest.mark.parametrize("name", REFUSED_CONTROL)
def test_published_bytes_that_are_no_control_message_are_refused(name: str) -> None:
    with pytest.raises(DecodeError):
        decode_control(bytes.fromhex(PUBLISHED["refused_control"][name]))


@pytest.mark.parametrize("name", ITEMS)
def test_published_items_decode_and_are_signed_as_the_format_says(name: str) -> None:
    vector, (_, item) = PUBLISHED["items"][name], ITEMS[name]
    data = bytes.fromhex(vector["hex"])
    assert decode_item(vector["topic"], data) == item
    topic, source, type_name = (vector[key].encode() for key in ("topic", "source", "type_name"))
    head = b"".join(
        (
            *(b"\x01", bytes((len(source),)), source, bytes.fromhex(vector["log_id"])),
            *(struct.pack(">QQ", vector["number"], vector["created_ms"]), bytes((len(type_name),)), type_name),
        )
    )
    key = Ed25519PrivateKey.from_private_bytes(bytes.fromhex(vector["seed"]))
    payload = bytes.fromhex(vector["payload"])
    signed = b"udp_mesh log item 1" + bytes((len(topic),)) + topic + head + payload
    assert data == head + key.sign(signed) + payload


@pytest.mark.parametrize("name", refused_items())
def test_published_items_that_their_source_did_not_sign_are_refused(name: str) -> None:
    vector = PUBLISHED["refused_items"][name]
    with pytest.raises(DecodeError):
        decode_item(vector["topic"], bytes.fromhex(vector["hex"]))
