"""Tables of subscriptions on the wire: every one survives, nothing else is accepted, and all is bounded."""

from __future__ import annotations

import fnmatch
import json
import time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.udp_mesh.wire.make_vectors import FOLDER
from tests.udp_mesh.wire.subscription_vectors import REFUSED_SUBSCRIPTIONS, SUBSCRIPTIONS
from udp_mesh.core.subscriptions.messages import (
    MAX_ENTRIES,
    MAX_GENERATION,
    MAX_PATTERNS,
    MAX_TABLE_BYTES,
    UNBOUNDED,
    Bounds,
    Subscription,
    SubscriptionTable,
    decode_message,
    encode_ask,
    encode_table,
)
from udp_mesh.core.subscriptions.table import MAX_REMEMBERED, KnownTable
from udp_mesh.wire.errors import DecodeError

PUBLISHED = json.loads((FOLDER / "subscriptions.json").read_text())
names = st.text(st.characters(codec="utf-8", categories=("L", "N", "P")), min_size=1, max_size=20)
amounts = st.one_of(st.none(), st.integers(1, 0xFFFFFFFF).map(lambda number: number / 1000))
subscriptions = st.builds(Subscription, names, st.builds(Bounds, amounts, amounts))
tables = st.builds(
    SubscriptionTable,
    st.integers(0, MAX_GENERATION),
    st.lists(subscriptions, max_size=MAX_PATTERNS).map(tuple),
    st.just(False),
)


@given(tables)
def test_decoding_inverts_encoding(table: SubscriptionTable) -> None:
    assert decode_message(encode_table(table)) == table


@given(st.binary(max_size=300), tables, st.integers(0, 1 << 20), st.integers(1, 255))
def test_any_other_bytes_are_a_table_or_refused(
    noise: bytes, table: SubscriptionTable, place: int, change: int
) -> None:
    changed = bytearray(encode_table(table))
    changed[place % len(changed)] ^= change
    for data in (noise, bytes(changed), bytes(changed)[: place % len(changed)], bytes(changed) + noise):
        try:
            found = decode_message(data)
        except DecodeError:
            continue
        assert found is None or len(found.subscriptions) <= MAX_ENTRIES


@pytest.mark.parametrize("name", SUBSCRIPTIONS)
def test_published_messages_are_read_and_written(name: str) -> None:
    message = SUBSCRIPTIONS[name]
    data = bytes.fromhex(PUBLISHED["accepted"][name]["hex"])
    assert decode_message(data) == message
    assert (encode_ask() if message is None else encode_table(message)) == data


@pytest.mark.parametrize("name", REFUSED_SUBSCRIPTIONS)
def test_published_faulty_messages_are_refused(name: str) -> None:
    with pytest.raises(DecodeError):
        decode_message(bytes.fromhex(PUBLISHED["refused"][name]))


@pytest.mark.parametrize(
    "entries",
    [
        tuple(Subscription(f"t{number}") for number in range(MAX_ENTRIES + 1)),
        tuple(Subscription(f"t{number}/*") for number in range(MAX_PATTERNS + 1)),
        tuple(Subscription(f"{number:03}" + "x" * 250) for number in range(MAX_TABLE_BYTES // 250)),
    ],
    ids=["entries", "patterns", "bytes"],
)
def test_a_node_that_reads_more_than_fits_asks_for_everything(entries: tuple[Subscription, ...]) -> None:
    encoded = encode_table(SubscriptionTable(7, entries))
    assert decode_message(encoded) == SubscriptionTable(7, (), everything=True)
    assert len(encoded) < 16


def test_the_largest_table_that_fits_is_sent() -> None:
    patterns = tuple(Subscription(f"p{number}/*") for number in range(MAX_PATTERNS))
    exact = tuple(Subscription(f"t{number}") for number in range(MAX_ENTRIES - MAX_PATTERNS))
    table = SubscriptionTable(1, (*patterns, *exact))
    assert decode_message(encode_table(table)) == table


def test_a_bound_below_the_units_stays_a_bound() -> None:
    table = decode_message(encode_table(SubscriptionTable(1, (Subscription("t", Bounds(1e-9, 1e-9)),))))
    assert table is not None
    assert table.subscriptions[0].bounds == Bounds(0.001, 0.001)


@given(st.lists(subscriptions, max_size=8), names)
def test_a_topic_is_wanted_as_the_most_demanding_reader_wants_it(entries: list[Subscription], topic: str) -> None:
    matching = [entry.bounds for entry in entries if fnmatch.fnmatchcase(topic, entry.pattern)]
    expected = None
    for bounds in matching:
        expected = bounds if expected is None else expected.united(bounds)
    table = KnownTable(SubscriptionTable(1, tuple(entries)), 0.0)
    assert table.bounds(topic) == table.bounds(topic) == expected


def test_one_unbounded_reader_gets_everything() -> None:
    table = KnownTable(
        SubscriptionTable(1, (Subscription("map", Bounds(1.0, 5.0)), Subscription("m*", Bounds(2.0, None)))), 0.0
    )
    assert table.bounds("map") == Bounds(2.0, None)
    assert (
        KnownTable(SubscriptionTable(1, (Subscription("map", Bounds(1.0)), Subscription("*"))), 0.0).bounds("map")
        == UNBOUNDED
    )
    assert KnownTable(SubscriptionTable(1, (), everything=True), 0.0).bounds("anything") == UNBOUNDED
    assert table.bounds("x") is None


def test_hostile_patterns_cost_little_more_than_harmless_ones() -> None:
    """Backtracking over many stars would take longer than the universe exists."""

    def cost_s(pattern: str) -> float:
        entries = tuple(Subscription(f"{number}" + pattern) for number in range(MAX_PATTERNS))
        table = KnownTable(SubscriptionTable(1, entries), 0.0)
        table.bounds("warm")
        begun = time.process_time()
        for number in range(50):
            table.bounds(f"{number}" + "a" * 250)
        return time.process_time() - begun

    assert cost_s("*a" * 120 + "b") < 1000 * cost_s("harmless-*" + "a" * 200)


def test_invented_topics_take_no_unbounded_memory() -> None:
    table = KnownTable(SubscriptionTable(1, (Subscription("*"),)), 0.0)
    for number in range(3 * MAX_REMEMBERED):
        assert table.bounds(f"t{number}") == UNBOUNDED
    assert len(table._answers) <= MAX_REMEMBERED
