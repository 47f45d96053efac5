"""Properties of sealing: what is sealed opens once, at its receiver, and nowhere else."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from udp_mesh.crypto import (
    LONG_OVERHEAD_BYTES,
    SHORT_OVERHEAD_BYTES,
    Key,
    OpenError,
    ReceiveChannel,
    ReplayError,
    SendChannel,
    age_together,
    check_long,
)
from udp_mesh.crypto.channel import MAX_PACKET_NUMBER, expand_number
from udp_mesh.crypto.replay import AGE_STEP_S
from udp_mesh.wire.header import Kind, LongHeader, ShortHeader, parse_header

KEY = Key(bytes(range(32)))
ALICE = b"alice's boot id."
BOB = b"bob's boot id..."
CAROL = b"carol's boot id."


def open_datagram(channel: ReceiveChannel, data: bytes) -> bytes:
    header = parse_header(data)
    if isinstance(header, LongHeader):
        check_long(channel.key, data, header)
        return channel.open_long(data, header)[1]
    return channel.open(data, header.number_low)[1]


@given(st.binary(max_size=100), st.booleans())
def test_sealed_datagrams_can_be_opened(frames: bytes, long: bool) -> None:
    sender, receiver = SendChannel(KEY, ALICE, BOB), ReceiveChannel(KEY, ALICE, BOB)
    number, data = sender.seal_long(frames) if long else sender.seal(frames)
    assert number == 0
    assert open_datagram(receiver, data) == frames
    assert len(data) - len(frames) == (LONG_OVERHEAD_BYTES if long else SHORT_OVERHEAD_BYTES)


@given(st.booleans(), st.data())
def test_a_modified_datagram_is_rejected(long: bool, data: st.DataObject) -> None:
    sender = SendChannel(KEY, ALICE, BOB)
    raw = bytearray(sender.seal_long(b"frames")[1] if long else sender.seal(b"frames")[1])
    place = data.draw(st.integers(1, len(raw) - 1))
    raw[place] ^= data.draw(st.integers(1, 255))
    receiver = ReceiveChannel(KEY, ALICE, BOB)
    header = parse_header(bytes(raw))
    if isinstance(header, LongHeader) or header.tag == receiver.tag:
        with pytest.raises(OpenError):
            open_datagram(receiver, bytes(raw))


@pytest.mark.parametrize(
    ("key", "sender", "receiver"),
    [
        (Key(bytes(32)), ALICE, BOB),
        (KEY, ALICE, CAROL),
        (KEY, CAROL, BOB),
        (KEY, BOB, ALICE),
    ],
    ids=["another key", "another receiver or its next boot", "another sender or its next boot", "reflected"],
)
def test_a_datagram_opens_only_in_its_own_channel(key: Key, sender: bytes, receiver: bytes) -> None:
    _, data = SendChannel(KEY, ALICE, BOB).seal(b"frames")
    channel = ReceiveChannel(key, sender, receiver)
    header = parse_header(data)
    assert isinstance(header, ShortHeader)
    with pytest.raises(OpenError):
        channel.open(data, header.number_low)


def test_broadcasts_and_unicasts_use_distinct_kinds() -> None:
    to_all, to_bob = SendChannel(KEY, ALICE), SendChannel(KEY, ALICE, BOB)
    kinds = [parse_header(data).kind for _, data in (to_all.seal_long(b"x"), to_all.seal(b"x"))]
    assert kinds == [Kind.HELLO, Kind.BROADCAST]
    kinds = [parse_header(data).kind for _, data in (to_bob.seal_long(b"x"), to_bob.seal(b"x"))]
    assert kinds == [Kind.INTRODUCTION, Kind.DATA]


def test_a_replayed_datagram_is_distinguished_from_a_forged_one() -> None:
    sender, receiver = SendChannel(KEY, ALICE, BOB), ReceiveChannel(KEY, ALICE, BOB)
    _, data = sender.seal(b"frames")
    open_datagram(receiver, data)
    with pytest.raises(ReplayError):
        open_datagram(receiver, data)


def test_a_forged_number_does_not_move_the_window() -> None:
    sender, receiver = SendChannel(KEY, ALICE, BOB), ReceiveChannel(KEY, ALICE, BOB)
    _, first = sender.seal(b"first")
    forged = first[:3] + b"\x7f\xff\xff\xff" + first[7:]
    with pytest.raises(OpenError):
        open_datagram(receiver, forged)
    assert open_datagram(receiver, first) == b"first"


def test_the_same_frames_never_give_the_same_bytes_not_even_after_a_restart() -> None:
    sealed = [
        channel.seal(b"same frames")[1][7:]
        for channel in (SendChannel(KEY, ALICE, BOB), SendChannel(KEY, CAROL, BOB), SendChannel(KEY, ALICE, CAROL))
        for _ in range(2)
    ]
    assert len(set(sealed)) == len(sealed)


def test_packet_number_exhaustion_raises_instead_of_wrapping() -> None:
    sender = SendChannel(KEY, ALICE, BOB)
    sender.next_number = MAX_PACKET_NUMBER
    sender.seal(b"last")
    with pytest.raises(OverflowError):
        sender.seal(b"one too many")


@given(st.integers(-1, 1 << 47), st.integers(-(1 << 30), 1 << 30))
def test_a_packet_number_is_expanded_from_its_low_half(largest: int, offset: int) -> None:
    number = largest + 1 + offset
    if number >= 0:
        assert expand_number(number & 0xFFFFFFFF, largest) == number


def test_packet_numbers_beyond_32_bits_are_accepted() -> None:
    sender, receiver = SendChannel(KEY, ALICE, BOB), ReceiveChannel(KEY, ALICE, BOB)
    for start in (0, 1 << 31, (1 << 32) - 1, (1 << 32) + 5):
        sender.next_number = start
        number, data = sender.seal(b"x")
        header = parse_header(data)
        assert isinstance(header, ShortHeader)
        assert receiver.open(data, header.number_low)[0] == number


def test_a_key_is_read_from_hexadecimal_and_base64_and_never_shown() -> None:
    import base64

    assert Key.parse(KEY.secret.hex() + "\n") == KEY == Key.parse(base64.b64encode(KEY.secret).decode())
    assert KEY.secret.hex() not in repr(KEY)
    with pytest.raises(ValueError) as caught:
        Key.parse("00ff" * 7)
    assert "00ff" not in str(caught.value)
    assert "28 characters" in str(caught.value)


def test_windows_of_one_channel_age_together() -> None:
    channels = [ReceiveChannel(key, ALICE, BOB) for key in (KEY, Key(bytes(range(1, 33))))]
    used, unused = (channel.window for channel in channels)
    assert used.accept(100)
    for step in range(3):
        assert unused.would_accept(99)
        age_together(channels, step * AGE_STEP_S)
    age_together(channels, 3 * AGE_STEP_S)
    assert not unused.would_accept(99)
    assert unused.would_accept(101)
