"""What the robots say to each other: the topics that udp_mesh carries."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum


class TopicClass(Enum):
    """What a topic is for; lint holds the order of priorities against it."""

    EMERGENCY_STOP = "emergency_stop"
    COMMAND = "command"
    ARTIFACT = "artifact"
    TELEMETRY = "telemetry"
    MAP = "map"
    VIDEO = "video"
    OTHER = "other"


class Outbox(Enum):
    """What is kept for a peer that is offline: nothing, the last value, or all of it (bounded)."""

    NONE = "none"
    LAST = "last"
    ALL = "all"


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
