"""Topics that udp_mesh carries between robots."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum


class TopicClass(Enum):
    """The purpose of a topic; lint checks priorities against it."""

    EMERGENCY_STOP = "emergency_stop"
    COMMAND = "command"
    ARTIFACT = "artifact"
    TELEMETRY = "telemetry"
    MAP = "map"
    VIDEO = "video"
    OTHER = "other"


class Outbox(Enum):
    """Messages kept for an offline peer: none, the last one, or all up to a limit."""

    NONE = "none"
    LAST = "last"
    ALL = "all"


@dataclass(frozen=True, slots=True)
class TopicLog:
    """A topic's messages are items of a shared log: numbered, kept on disk by every robot within these limits, and
    passed on until the topic's destinations have them. `copies` robots that reach each other carry an item."""

    max_items: int = 10_000
    max_bytes: int = 256 << 20
    max_age_s: float | None = None
    copies: int = 3


@dataclass(frozen=True, slots=True)
class Topic:
    """`priority` 0 is the most urgent, 15 the least. `sources` and `destinations` name robots; empty sources means
    every robot, the destination `all` means broadcast. `rate_hz` x `size_bytes` is the offered load per source."""

    name: str
    priority: int
    topic_class: TopicClass = TopicClass.OTHER
    type_name: str = ""
    reliable: bool = True
    sources: tuple[str, ...] = ()
    destinations: tuple[str, ...] = ("all",)
    rate_hz: float = 0.0
    size_bytes: int = 0
    keep_last: int = 0
    deadline_s: float | None = None
    rate_limit_bytes_per_s: int | None = None
    compression: bool = False
    outbox: Outbox = Outbox.NONE
    outbox_bytes: int = 1_000_000
    outbox_on_disk: bool = False
    repair: bool = False
    log: TopicLog | None = None
    delta: bool = False
    delta_bytes: int = 16 << 20
