"""An item is what its source signed, or nothing."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from udp_mesh.core.logs.item import ItemId, LogItem, LogKey, decode_item, encode_item
from udp_mesh.core.logs.messages import MAX_ORDER, Have, HaveEntry, Holder, ItemRequest, decode_control, encode_control
from udp_mesh.crypto.signing import SigningKey
from udp_mesh.wire.errors import DecodeError

KEY = SigningKey(bytes(range(32)))
LOG = LogKey("artifact", "spot", KEY.public)
ITEM = LogItem(ItemId(LOG, 7), 1_700_000_000_123, "std_msgs/String", b"backpack at 3, 4")


@given(
    st.integers(1, (1 << 48) - 1),
    st.integers(0, (1 << 64) - 1),
    st.text("abc/Ä", max_size=40),
    st.binary(max_size=300),
)
def test_decoding_inverts_encoding(number: int, created_ms: int, type_name: str, payload: bytes) -> None:
    item = LogItem(ItemId(LOG, number), created_ms, type_name, payload)
    assert decode_item("artifact", encode_item(KEY, item)) == item


@given(st.integers(0, 200), st.integers(1, 255))
def test_an_item_with_any_changed_byte_is_refused(place: int, change: int) -> None:
    data = bytearray(encode_item(KEY, ITEM))
    data[place % len(data)] ^= change
    with pytest.raises(DecodeError):
        decode_item("artifact", bytes(data))


def test_an_item_cannot_be_moved_to_another_topic() -> None:
    with pytest.raises(DecodeError, match="expected its source's signature"):
        decode_item("estop", encode_item(KEY, ITEM))


def test_only_the_owner_of_a_log_can_sign_for_it() -> None:
    with pytest.raises(ValueError, match="does not belong"):
        encode_item(SigningKey(bytes(32)), ITEM)


@given(st.binary(max_size=400))
def test_any_bytes_give_an_item_or_a_decode_error(data: bytes) -> None:
    with pytest.raises(DecodeError):
        decode_item("artifact", data)


ranges = st.lists(st.integers(0, 10_000), unique=True, max_size=20).map(
    lambda numbers: tuple(
        (2 * first + 1, 2 * last + 1) for first, last in zip(sorted(numbers)[::2], sorted(numbers)[1::2], strict=False)
    )
)
logs = st.builds(
    LogKey, st.text("abc/", min_size=1, max_size=9), st.text("abc", min_size=1, max_size=9), st.just(b"i" * 32)
)
holders = st.builds(Holder, st.text("xyz", min_size=1, max_size=5), ranges)
messages = st.one_of(
    st.builds(
        Have,
        st.lists(
            st.builds(HaveEntry, logs, ranges, st.lists(holders, max_size=3).map(tuple), st.booleans()), max_size=4
        ).map(tuple),
        st.booleans(),
        st.booleans(),
        st.integers(0, MAX_ORDER),
    ),
    st.builds(ItemRequest, st.lists(st.tuples(logs, ranges), max_size=4).map(tuple)),
)


@given(messages)
def test_decoding_inverts_encoding_of_control_messages(message: Have | ItemRequest) -> None:
    assert decode_control(encode_control(message)) == message


@given(st.binary(max_size=300), messages, st.integers(0, 300), st.integers(1, 255))
def test_any_control_bytes_give_a_message_or_a_decode_error(
    noise: bytes, message: Have | ItemRequest, place: int, change: int
) -> None:
    damaged = bytearray(encode_control(message))
    damaged[place % len(damaged)] ^= change
    for data in (noise, bytes(damaged), bytes(damaged[: place % len(damaged)])):
        try:
            decode_control(data)
        except DecodeError:
            continue


def test_ranges_beyond_the_limit_keep_the_newest() -> None:
    many = tuple((number, number) for number in range(1, 2001, 2))
    decoded = decode_control(encode_control(Have((HaveEntry(LOG, many),))))
    assert isinstance(decoded, Have)
    assert decoded.entries[0].held == many[-256:]
