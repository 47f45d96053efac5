"""The messages about subscriptions: `Ask` for a peer's table, and `Table`, the answer, repeated after each change.

Both travel as messages of reserved topics, so that the transport's priorities, acknowledgments and encryption apply to
them. All numbers are bounded; a decoder returns a value or raises `DecodeError`.

    Table: 1 | flags 1 (bit 0: everything is read) | generation 4 | entries 2, each:
           pattern (text) | messages per 1,000 s 4 (0: unbounded) | maximum age in ms 4 (0: unbounded)
    Ask:   2
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, replace
from typing import NamedTuple

from udp_mesh.core.settings import Settings, Topic
from udp_mesh.wire.buffer import Reader, encode_text
from udp_mesh.wire.errors import DecodeError
from udp_mesh.wire.limits import MAX_TOPIC_BYTES

TABLE_TOPIC = "~mesh/subscriptions"
ASK_TOPIC = "~mesh/subscriptions/ask"
"""Reserved topics of the two messages: one would not replace the other in a queue."""

MAX_ENTRIES = 512
"""Names and patterns in a table: bounds the memory and the work that a peer's table costs."""
MAX_PATTERNS = 32
"""Entries with wildcards among them: each is compared with each topic that is sent."""
MAX_TABLE_BYTES = 16 << 10
"""A table's bytes: those of a thousand peers fit 16 MiB. A node whose programs read more asks for everything."""

MIN_RATE_HZ, MAX_RATE_HZ = 0.001, 1e6
MIN_AGE_S, MAX_AGE_S = 0.001, 4e6
"""Bounds that the format can carry; a larger age is no bound."""

_WILDCARDS = frozenset("*?[")
_TABLE, _ASK = 1, 2
_EVERYTHING = 1
_HEAD = struct.Struct(">BBIH")
_BOUNDS = struct.Struct(">II")
MAX_GENERATION = (1 << 32) - 1


class Bounds(NamedTuple):
    """How much of a topic is wanted: at most `rate_hz` messages a second from each sender, none older than `max_age_s`
    (None: no bound)."""

    rate_hz: float | None = None
    max_age_s: float | None = None

    def united(self, other: Bounds) -> Bounds:
        """Bounds that satisfy both readers."""
        return Bounds(_larger(self.rate_hz, other.rate_hz), _larger(self.max_age_s, other.max_age_s))


UNBOUNDED = Bounds()


def _larger(a: float | None, b: float | None) -> float | None:
    return None if a is None or b is None else max(a, b)


class Subscription(NamedTuple):
    """A subscription of a node's programs: a topic's name or a pattern as in fnmatch."""

    pattern: str
    bounds: Bounds = UNBOUNDED

    @property
    def has_wildcard(self) -> bool:
        return not _WILDCARDS.isdisjoint(self.pattern)


@dataclass(frozen=True, slots=True)
class SubscriptionTable:
    """All subscriptions of a node's programs; `everything`: more than fits, or not known. A higher generation is
    newer."""

    generation: int
    subscriptions: tuple[Subscription, ...] = ()
    everything: bool = False


def with_subscription_topics(settings: Settings) -> Settings:
    """The settings with the reserved topics of subscriptions, if it sends selectively. They go ahead of everything that
    is not urgent: until a table arrives, too much is sent, or too little."""
    if not settings.selective:
        return settings
    priority = min(settings.rates.urgent_priority + 1, 15)
    added = [Topic(name, priority=priority, keep_last=1, always=True) for name in (TABLE_TOPIC, ASK_TOPIC)]
    return replace(settings, topics=(*settings.topics, *added))


def is_about_subscriptions(topic: str) -> bool:
    """Whether this is one of the reserved topics."""
    return topic in (TABLE_TOPIC, ASK_TOPIC)


def encode_ask() -> bytes:
    return bytes((_ASK,))


def encode_table(table: SubscriptionTable) -> bytes:
    """The bytes of a table; of one beyond the limits, those of one that asks for everything."""
    entries = b"".join(
        encode_text(pattern, MAX_TOPIC_BYTES, "pattern")
        + _BOUNDS.pack(_scaled(bounds.rate_hz, 1000), _scaled(bounds.max_age_s, 1000))
        for pattern, bounds in table.subscriptions
    )
    patterns = sum(subscription.has_wildcard for subscription in table.subscriptions)
    too_much = (
        len(table.subscriptions) > MAX_ENTRIES or patterns > MAX_PATTERNS or len(entries) + _HEAD.size > MAX_TABLE_BYTES
    )
    if table.everything or too_much:
        return _HEAD.pack(_TABLE, _EVERYTHING, table.generation, 0)
    return _HEAD.pack(_TABLE, 0, table.generation, len(table.subscriptions)) + entries


def _scaled(value: float | None, factor: int) -> int:
    return 0 if value is None else max(1, min(round(value * factor), 0xFFFFFFFF))


def decode_message(data: bytes | memoryview) -> SubscriptionTable | None:
    """The table in these bytes, or None for an `Ask`. Raises DecodeError."""
    if len(data) > MAX_TABLE_BYTES:
        raise DecodeError(f"subscriptions: expected at most {MAX_TABLE_BYTES} bytes, found {len(data)}")
    reader = Reader(data)
    kind = reader.integer(1, "kind of message about subscriptions")
    if kind == _ASK:
        table = None
    elif kind == _TABLE:
        flags = reader.integer(1, "flags")
        generation = reader.integer(4, "generation")
        entries = [_read_entry(reader) for _ in range(reader.at_most(2, MAX_ENTRIES, "entries"))]
        patterns = sum(entry.has_wildcard for entry in entries)
        if patterns > MAX_PATTERNS:
            raise DecodeError(f"subscriptions: expected at most {MAX_PATTERNS} patterns, found {patterns}")
        table = SubscriptionTable(generation, tuple(entries), bool(flags & _EVERYTHING))
    else:
        raise DecodeError(f"kind of message about subscriptions: expected {_TABLE} or {_ASK}, found {kind}")
    if reader.remaining():
        raise DecodeError(f"subscriptions: expected their end, found {reader.remaining()} more bytes")
    return table


def _read_entry(reader: Reader) -> Subscription:
    pattern = reader.text(MAX_TOPIC_BYTES, "pattern")
    if not pattern:
        raise DecodeError("pattern: expected at least one character, found none")
    rate, age_ms = reader.integer(4, "rate"), reader.integer(4, "maximum age")
    return Subscription(pattern, Bounds(rate / 1000 if rate else None, age_ms / 1000 if age_ms else None))
