"""Properties of the frames: what is encoded is decoded, and any bytes give frames or DecodeError."""

import struct
from dataclasses import replace

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from tests.udp_mesh.wire.strategies import frames as any_frame
from udp_mesh.core.sender.path import IP6_EXTRA_BYTES, IP_UDP_BYTES
from udp_mesh.crypto import LONG_OVERHEAD_BYTES
from udp_mesh.wire import limits
from udp_mesh.wire.codec import decode, encode
from udp_mesh.wire.errors import DecodeError
from udp_mesh.wire.fragment import FRAGMENT_BYTES
from udp_mesh.wire.frames import Ack, Cancel, Fragment, Frame, Heartbeat, MessageHead, Nack, Ping, Waiting


@given(st.lists(any_frame, min_size=1, max_size=6))
def test_decoding_inverts_encoding(frames: list[Frame]) -> None:
    assert decode(encode(frames)) == frames
    assert decode(encode(frames, compact=True)) == frames


@given(st.lists(any_frame, min_size=1, max_size=3), st.data())
def test_a_truncated_datagram_gives_no_extra_frames_or_an_error(frames: list[Frame], data: st.DataObject) -> None:
    raw = encode(frames)
    cut = raw[: data.draw(st.integers(0, len(raw) - 1))]
    try:
        decoded = decode(cut)
    except DecodeError:
        return
    assert len(decoded) <= len(frames)


@given(st.binary(max_size=200))
@example(b"")
@example(b"\x80")
@example(b"\xff" * 40)
def test_any_bytes_give_frames_within_the_caps_or_an_error(raw: bytes) -> None:
    try:
        frames = decode(raw)
    except DecodeError:
        return
    assert 1 <= len(frames) <= limits.MAX_FRAMES_PER_DATAGRAM
    # Only what would be written is accepted: the format has one encoding per value, except for trailing lengths.
    assert decode(encode(frames)) == frames


@given(any_frame, st.data())
def test_a_flipped_byte_gives_frames_or_an_error(frame: Frame, data: st.DataObject) -> None:
    raw = bytearray(encode([frame]))
    raw[data.draw(st.integers(0, len(raw) - 1))] ^= data.draw(st.integers(1, 255))
    try:
        decode(bytes(raw))
    except DecodeError:
        return


def test_a_bulk_fragment_costs_seven_bytes() -> None:
    raw = encode([Fragment(5, 17, b"x" * 1400)])
    assert len(raw) == 1400 + FRAGMENT_BYTES == 1407


def test_a_small_message_among_others_costs_thirteen_bytes() -> None:
    message = Fragment(1, 0, b"0123456789", MessageHead(10, 1, 2, 5, 1))
    assert len(encode([message, message], compact=True)) - len(encode([message], compact=True)) == 10 + 13


def test_an_acknowledgement_without_gaps_costs_no_bitmap() -> None:
    complete = encode([Ack(1000, (1 << 256) - 1, 0, 0)])
    gap = encode([Ack(1000, (1 << 256) - 1 - (1 << 9), 0, 0)])
    assert len(complete) == 16
    assert len(gap) == 18


def test_a_full_heartbeat_fits_one_datagram() -> None:
    heard = tuple(struct.pack(">Q", n) for n in range(limits.MAX_HEARD))
    waiting = tuple(Waiting(level, 65_535) for level in range(16))
    beat = Heartbeat("n" * 63, 1, 1, 0, 1000, 1000, 0, 0, 0, heard, waiting, 0, (0,) * limits.MAX_HEARD_CLOCKS)
    assert len(encode([beat])) + LONG_OVERHEAD_BYTES + IP_UDP_BYTES + IP6_EXTRA_BYTES <= 1280


def test_too_many_frames_are_refused() -> None:
    with pytest.raises(DecodeError, match="at most 64 frames"):
        decode(encode([Ping(1)]) * 65)


@pytest.mark.parametrize(
    ("raw", "message"),
    [
        (b"\x00", "frame type"),
        (b"\x0b", "frame type"),
        (b"\xe0" + bytes(8), "flags"),
        (struct.pack(">BIH", 0x80, 1, 0) + b"x", "head"),
        (struct.pack(">BIH", 0x80, 1, 4), "payload"),
        (struct.pack(">BIHIIIHBB", 0x81, 1, 0, 0xFFFFFFFF, 1, 0, 0, 0, 0), "message size"),
        (struct.pack(">BIHIIIHBB", 0x81, 1, 0, 10, 0xFFFFFFFF, 0, 0, 0, 0), "number of fragments"),
        (struct.pack(">BIHIIIHBB", 0x81, 1, 0, 10, 11, 0, 0, 0, 0), "empty"),
        (struct.pack(">BIHIIIHBB", 0x81, 1, 0, 10, 0, 0, 0, 0, 0), "empty"),
        (struct.pack(">BIHIIIHBB", 0x81, 1, 0, 2, 1, 0, 0, 0, 0) + b"x", "contradict"),
        (struct.pack(">BIHIIIHBB", 0x81, 1, 0, 1, 1, 0, 0, 16, 0) + b"x", "priority"),
        (struct.pack(">BIHBBH", 0xC0, 1, 2, 0, 0, 0) + b"x", "compact"),
        (struct.pack(">BIHBBH", 0xC9, 1, 2, 0, 0, 0) + b"x", "compact"),
        (struct.pack(">BIHBBH", 0xC1, 1, 2, 16, 0, 0) + b"x", "priority"),
        (struct.pack(">BIHBBHI", 0xE1, 1, 2, 0, 0, 0, 0) + b"x", "lifetime"),
        (struct.pack(">BIHBBHH", 0xC3, 1, 2, 0, 0, 0, 9) + b"x", "expected 9 bytes, found 1"),
        (struct.pack(">BIHB", 0xC1, 1, 2, 0), "expected 10 bytes"),
        (struct.pack(">BIHH", 0x82, 1, 3, 100) + b"x" * 99, "expected 100 bytes, found 99"),
        (struct.pack(">BII", 0x88, 1, 1 << 21) + b"x", "out of range"),
        (struct.pack(">BIBII", 6, 1, 1, 0, 0xFFFFFFFF), "out of range"),
        (bytes((3, 0, 255, 255)), "number of message ids"),
        (bytes((2,)) + bytes(13) + bytes((33,)), "bitmap length"),
        (bytes((1, 3)) + b"a b" + bytes(40), "white space"),
    ],
)
def test_an_invalid_value_is_an_error_that_names_it(raw: bytes, message: str) -> None:
    with pytest.raises(DecodeError, match=message):
        decode(raw)


@pytest.mark.parametrize(
    "frame",
    [
        Fragment(1, 0, b"x"),
        Fragment(1, 1, b"x", MessageHead(1, 1, 0, 0, 0)),
        Fragment(1, 0, b"x", MessageHead(1, 2, 0, 0, 0)),
        Fragment(1, 0, b"x", MessageHead(1, 1, 0, 16, 0)),
        Cancel(()),
        Nack(1, ((0, 1),) * 65),
        Heartbeat("n" * 64, 1, 1, 0, 1, 0, 0, 0, 0),
        Heartbeat("ugv1", 1, 1, 0, 1, 0, 0, 0, 0, (b"peerone!",), (), 0, (1, 2)),
        Heartbeat("ugv1", 1, 1, 0, 1, 0, 0, 0, 0, (b"peerone!",), (), None, (1,)),
    ],
)
def test_encoding_an_invalid_frame_raises_value_error(frame: Frame) -> None:
    with pytest.raises(ValueError):
        encode([frame])


def test_a_heartbeat_of_a_later_version_may_be_longer() -> None:
    beat = Heartbeat("ugv1", 1, 2, 0, 1000, 0, 0, 0, 0)
    raw = encode([beat])
    assert decode(raw[:-1] + b"\x03new" + encode([Ping(7)])) == [beat, Ping(7)]


@pytest.mark.parametrize(
    ("extension", "clock_ms", "heard_clocks"),
    [
        ("00000007", 7, ()),
        ("00000007 000001", 7, (1,)),
        ("00000007 000001 ffffff", 7, (1, 0xFFFFFF)),
        ("00000007 000001 ffffff 0a0b0c0d", 7, (1, 0xFFFFFF)),
        ("00000007 0000", 7, ()),
        ("0007", None, ()),
    ],
)
def test_the_extension_of_any_version_is_read(
    extension: str, clock_ms: int | None, heard_clocks: tuple[int, ...]
) -> None:
    """There are no more clocks than heard boots; what follows them is of a later version."""
    beat = Heartbeat("ugv1", 1, 1, 0, 1000, 0, 0, 0, 0, (b"peerone!", b"peertwo!"))
    fields = bytes.fromhex(extension)
    raw = encode([beat])[:-1] + bytes((len(fields),)) + fields
    assert decode(raw) == [replace(beat, clock_ms=clock_ms, heard_clocks=heard_clocks)]
