"""Properties of the clear header."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from udp_mesh.wire.errors import DecodeError, UnknownVersionError
from udp_mesh.wire.header import (
    MARK,
    NUMBER_LOW_MASK,
    SHORT_HEADER,
    VERSION,
    Kind,
    LongHeader,
    ShortHeader,
    encode_long,
    parse_header,
)


@given(st.sampled_from([Kind.BROADCAST, Kind.DATA]), st.integers(0, 65_535), st.integers(0, (1 << 48) - 1))
def test_a_short_header_round_trips_with_the_low_half_of_its_packet_number(kind: Kind, tag: int, number: int) -> None:
    raw = SHORT_HEADER.pack(MARK | VERSION << 4 | kind, tag, number & NUMBER_LOW_MASK) + bytes(16)
    assert parse_header(raw) == ShortHeader(kind, tag, number & 0xFFFFFFFF)


@given(st.sampled_from([Kind.HELLO, Kind.INTRODUCTION]), st.binary(min_size=16, max_size=16))
def test_a_long_header_round_trips(kind: Kind, boot: bytes) -> None:
    raw = encode_long(kind, b"keyi", boot, 77) + b"chek" + bytes(16)
    assert parse_header(memoryview(raw)) == LongHeader(kind, b"keyi", boot, 77, b"chek")


@given(st.binary(max_size=80))
def test_any_bytes_give_a_header_or_an_error(raw: bytes) -> None:
    try:
        parse_header(raw)
    except DecodeError:
        return
    assert raw[0] in (0x90, 0x91, 0x92, 0x93)


@pytest.mark.parametrize("first", [1, 2, 4, 5])
def test_no_legacy_datagram_looks_like_ours(first: int) -> None:
    raw = bytes((first,)) + bytes(60)
    with pytest.raises(DecodeError, match="mark"):
        parse_header(raw)


def test_an_unknown_version_error_carries_the_version() -> None:
    with pytest.raises(UnknownVersionError) as caught:
        parse_header(bytes((0x80 | 3 << 4,)) + bytes(60))
    assert caught.value.version == 3
