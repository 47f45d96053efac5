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
class JpegEncoding:
    """JPEG quality (1 to 95), adapted down to `min_quality`; width and height are multiplied by `scale`."""

    quality: int = 60
    min_quality: int = 10
    scale: float = 1.0


@dataclass(frozen=True, slots=True)
class Reduction:
    """How the ROS bridge reduces the published messages: at most `rate_hz` messages a second, images as JPEG, of
    point clouds one point per cube of `voxel_m` (adapted up to `max_voxel_m`) with these `fields` (empty: all)."""

    rate_hz: float | None = None
    encode: JpegEncoding | None = None
    voxel_m: float | None = None
    max_voxel_m: float | None = None
    fields: tuple[str, ...] = ()
    adapt: bool = False


@dataclass(frozen=True, slots=True)
class Topic:
    """`priority` 0 is the most urgent, 15 the least. `sources` and `destinations` name robots; empty sources means
    every robot, the destination `all` means broadcast. `sent_rate_hz` x `size_bytes` is the offered load per source:
    the size is that of a message as sent, after `reduce`.
    With `thin` the thin links in `thin_links` (empty: all) carry it, too, at most once in `thin_period_s`."""

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
    reduce: Reduction | None = None
    always: bool = False
    thin: bool = False
    thin_links: tuple[str, ...] = ()
    thin_period_s: float | None = None

    @property
    def sent_rate_hz(self) -> float:
        """The rate after the bridge's throttle."""
        limit_hz = None if self.reduce is None else self.reduce.rate_hz
        return self.rate_hz if limit_hz is None else min(self.rate_hz, limit_hz)
