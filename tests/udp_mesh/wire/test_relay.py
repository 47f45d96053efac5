"""Relay frames: what is encoded is decoded, and any bytes give a frame or `DecodeError`."""

from __future__ import annotations

import contextlib

from hypothesis import given
from hypothesis import strategies as st

from udp_mesh.wire.errors import DecodeError
from udp_mesh.wire.relay import (
    Carry,
    HeardHop,
    HopAck,
    RelayedNode,
    RelayHello,
    decode_relay,
    encode_carry,
    encode_hello,
    encode_hop_ack,
)

HELLO = RelayHello(
    "husky1",
    True,
    1000,
    7,
    (b"\x01" * 8,),
    (HeardHop(b"\x02" * 8, 6, 255, True),),
    (RelayedNode(b"\x03" * 16, 5, 16, 1, 1500, True, "uav1", (b"\x04" * 8,)),),
)
HELLO_HEX = (
    "010103e800000007" "06" + b"husky1".hex() + "01" + "01" * 8 + "01" + "02" * 8 + "00000006" "ff01" "01"
    + "03" * 16 + "00000005" "0010" "01" "05dc" "01" "04" + b"uav1".hex() + "01" + "04" * 8
)  # fmt: skip


def test_the_vectors_of_the_wire_format_page() -> None:
    assert encode_hello(HELLO).hex() == HELLO_HEX
    carry = Carry(3, 4, b"\x05" * 8, b"\x06" * 8, (b"\x07" * 4,), b"sealed")
    assert encode_carry(carry).hex() == "0234" + "05" * 8 + "06" * 8 + "01" + "07" * 4 + b"sealed".hex()
    assert encode_hop_ack(HopAck(258, 3)).hex() == "03000000000102000003"


def test_what_is_encoded_is_decoded() -> None:
    assert decode_relay(encode_hello(HELLO)) == HELLO
    assert decode_relay(encode_hop_ack(HopAck(1 << 40, 99))) == HopAck(1 << 40, 99)
    carry = Carry(15, 8, b"\x05" * 8, b"\x06" * 8, (b"\x07" * 4,) * 7, b"")
    assert decode_relay(encode_carry(carry)) == carry


@given(st.binary(max_size=200))
def test_any_bytes_give_a_frame_or_a_decode_error(data: bytes) -> None:
    for kind in (b"", b"\x01", b"\x02", b"\x03"):
        with contextlib.suppress(DecodeError):
            decode_relay(kind + data)
