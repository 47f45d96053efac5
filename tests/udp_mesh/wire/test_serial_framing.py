"""Frames on a serial line: what is encoded arrives, damage is noticed, and a receiver is soon back in step."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from udp_mesh.wire.limits import MAX_THIN_FRAME_BYTES
from udp_mesh.wire.serial_framing import (
    DELIMITER,
    FRAMING_BYTES,
    LineDecoder,
    cobs_decode,
    cobs_encode,
    crc16_x25,
    encode_line,
)

FRAMES = st.lists(st.binary(min_size=1, max_size=MAX_THIN_FRAME_BYTES), max_size=5)


def test_the_crc_has_the_check_value_of_its_catalogue() -> None:
    assert crc16_x25(b"123456789") == 0x906E


def test_cobs_encodes_the_examples_of_its_paper() -> None:
    """Cheshire and Baker, and the usual corner cases around a block of 254 bytes."""
    assert cobs_encode(b"\x00") == b"\x01\x01"
    assert cobs_encode(b"\x00\x00") == b"\x01\x01\x01"
    assert cobs_encode(b"\x11\x22\x00\x33") == b"\x03\x11\x22\x02\x33"
    assert cobs_encode(b"\x11\x00\x00\x00") == b"\x02\x11\x01\x01\x01"
    counted = bytes(range(1, 255))
    assert cobs_encode(counted) in (b"\xff" + counted, b"\xff" + counted + b"\x01")
    assert cobs_decode(b"\xff" + counted) == counted


@given(st.binary(max_size=600))
def test_cobs_has_no_zero_and_is_reversible(data: bytes) -> None:
    encoded = cobs_encode(data)
    assert 0 not in encoded
    assert cobs_decode(encoded) == data
    assert len(encoded) <= len(data) + 1 + len(data) // 254


@given(FRAMES, st.lists(st.integers(1, 400), max_size=30))
def test_frames_arrive_however_the_line_is_cut(frames: list[bytes], cuts: list[int]) -> None:
    line = b"".join(map(encode_line, frames))
    decoder, found, at = LineDecoder(), [], 0
    for cut in [*cuts, len(line)]:
        found += decoder.feed(line[at : at + cut])
        at += cut
    assert found == frames
    assert decoder.damaged == 0


@given(st.binary(max_size=700), FRAMES)
def test_whatever_came_before_the_next_frames_arrive(noise: bytes, frames: list[bytes]) -> None:
    decoder = LineDecoder()
    decoder.feed(noise)
    decoder.feed(DELIMITER)
    assert decoder.feed(b"".join(map(encode_line, frames))) == frames


@given(st.binary(min_size=1, max_size=100), st.data())
def test_a_changed_byte_is_noticed(frame: bytes, data: st.DataObject) -> None:
    line = bytearray(encode_line(frame))
    place = data.draw(st.integers(1, len(line) - 2))
    line[place] ^= data.draw(st.integers(1, 255))
    decoder = LineDecoder()
    assert frame not in decoder.feed(bytes(line))
    assert decoder.damaged >= 1


def test_an_endless_line_is_held_up_to_one_frame() -> None:
    decoder = LineDecoder()
    for _ in range(1000):
        assert decoder.feed(b"\x55" * 100) == []
    assert len(decoder._unfinished) <= MAX_THIN_FRAME_BYTES + FRAMING_BYTES
    assert decoder.feed(DELIMITER) == []
    assert decoder.damaged == 1
    assert decoder.feed(encode_line(b"after")) == [b"after"]


def test_the_framing_costs_what_airtime_counts() -> None:
    for size in (1, 64, 253):
        assert len(encode_line(b"\x01" * size)) <= size + FRAMING_BYTES


def test_a_frame_longer_than_any_counts_as_damage() -> None:
    """The encoding of one that is a little too long is no longer than the worst case of others."""
    decoder = LineDecoder()
    assert decoder.feed(encode_line(b"x" * MAX_THIN_FRAME_BYTES)) == [b"x" * MAX_THIN_FRAME_BYTES]
    assert decoder.feed(encode_line(b"x" * (MAX_THIN_FRAME_BYTES + 1))) == []
    assert decoder.damaged == 1
