"""Properties of the legacy format, and defects of the legacy reader that ours does not have."""

import struct

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from udp_mesh.wire.errors import DecodeError
from udp_mesh.wire.legacy import (
    LEGACY_OVERHEAD_BYTES,
    Host,
    LegacyAck,
    LegacyDatagram,
    LegacyPayload,
    PriorityMeshData,
    decapsulate,
    decode_legacy,
    decode_mesh_data,
    encapsulate,
    encode_legacy,
    encode_mesh_data,
    fragment_legacy,
    is_legacy,
)

words = st.text(st.characters(min_codepoint=0x21, max_codepoint=0x7E), min_size=1, max_size=15).filter(
    lambda word: "/" not in word
)


@st.composite
def payloads(draw: st.DrawFn) -> LegacyPayload:
    total = draw(st.integers(1, 65_536))
    position = draw(st.integers(0, total - 1))
    return LegacyPayload(draw(st.integers(0, 65_535)), position, total, draw(st.binary()), draw(st.booleans()))


datagrams: st.SearchStrategy[LegacyDatagram] = st.one_of(
    st.builds(Host, words, words),
    payloads(),
    st.builds(LegacyAck, st.integers(0, 65_535), st.integers(0, (1 << 32) - 1)),
)


@given(datagrams)
def test_decoding_inverts_encoding(datagram: LegacyDatagram) -> None:
    raw = encode_legacy(datagram)
    assert is_legacy(raw)
    assert decode_legacy(raw) == datagram


@given(st.binary(max_size=120))
@example(bytes((1,)) + bytes(13))
def test_any_bytes_give_a_datagram_or_an_error(raw: bytes) -> None:
    try:
        decode_legacy(raw)
    except DecodeError:
        return


@given(
    st.builds(
        PriorityMeshData,
        host=words,
        type_name=words,
        priority=st.integers(0, 255),
        topic=words,
        data=st.binary(),
        sequence=st.integers(0, (1 << 32) - 1),
        frame_id=words,
    )
)
def test_messages_round_trip(message: PriorityMeshData) -> None:
    assert decode_mesh_data(encode_mesh_data(message)) == message


@given(st.binary(max_size=120))
def test_any_bytes_give_a_message_or_an_error(raw: bytes) -> None:
    try:
        decode_mesh_data(raw)
    except DecodeError:
        return


def test_encoded_bytes_match_the_legacy_code() -> None:
    host = encode_legacy(Host("ugv1", "10.0.0.1"))
    assert host == struct.pack("<BHIIH", 4, 0, 0, 0, 80) + struct.pack("<64p16p", b"ugv1", b"10.0.0.1") + b"\x00"
    payload = encode_legacy(LegacyPayload(0x7FFF, 2, 3, b"abc", wants_ack=True))
    assert payload.hex() == "01ff7f02000000030000000300" + b"abc".hex() + "00"
    assert encode_legacy(LegacyAck(0x7FFF, 2)).hex() == "02ff7f0200000000000000000000"


@pytest.mark.parametrize(("size", "fragments"), [(0, 1), (1, 1), (1299, 1), (1300, 2), (2600, 3), (2601, 3)])
def test_an_exact_multiple_ends_in_an_empty_fragment_as_legacy_receivers_expect(size: int, fragments: int) -> None:
    message = bytes(size)
    pieces = fragment_legacy(message)
    assert len(pieces) == fragments == size // 1300 + 1
    assert b"".join(pieces) == message


def test_defect_2_a_huge_total_is_refused_before_anything_is_allocated() -> None:
    with pytest.raises(DecodeError, match="out of range"):
        decode_legacy(struct.pack("<BHIIH", 1, 1, 0, 0xFFFFFFFF, 1) + b"x\x00")


def test_defect_3_a_position_past_the_total_is_refused() -> None:
    with pytest.raises(DecodeError, match="out of range"):
        decode_legacy(struct.pack("<BHIIH", 1, 1, 7, 7, 1) + b"x\x00")


def test_defect_4_an_unknown_type_is_a_decode_error() -> None:
    with pytest.raises(DecodeError, match="expected 1, 2, 4 or 5, found 9"):
        decode_legacy(struct.pack("<BHIIH", 9, 1, 0, 1, 1) + b"x\x00")


@given(st.binary(max_size=1500))
def test_an_encapsulated_datagram_looks_like_an_acknowledgement_to_legacy_programs(data: bytes) -> None:
    covered = encapsulate(data)
    assert decode_legacy(covered) == LegacyAck(0xFFFF, 0xFFFFFFFF)
    assert decapsulate(covered) == data
    assert len(covered) == len(data) + LEGACY_OVERHEAD_BYTES


@given(st.binary(max_size=40))
def test_other_bytes_are_not_decapsulated(data: bytes) -> None:
    assert data[:11] == encapsulate(b"")[:11] or decapsulate(data) is None
