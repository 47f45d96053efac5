"""Thin links in a recording: `thin` of its conditions -> samples -> what each link and each node on them did.

`thin` has `links`, a list of `name`, `up`, `airtime_s`, `queued_messages` and counters (totals since the daemon's
start), and `peers`, a list of `name` and `present`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields
from typing import Any

from udp_mesh.report.fields import UnreadableError, integer, number, rows, text

MAX_AIRTIME_S = 1e9


@dataclass(frozen=True, slots=True)
class ThinLinkTotals:
    """Totals of a thin link since the daemon's start."""

    airtime_s: float = 0.0
    frames_sent: int = 0
    bytes_sent: int = 0
    frames_received: int = 0
    frames_forged: int = 0
    frames_rejected: int = 0
    parts_repeated: int = 0
    messages_given_up: int = 0
    messages_dropped: int = 0

    def since(self, earlier: ThinLinkTotals) -> ThinLinkTotals:
        """The difference from earlier totals."""
        return ThinLinkTotals(*(getattr(self, field.name) - getattr(earlier, field.name) for field in fields(self)))


@dataclass(frozen=True, slots=True)
class ThinLinkSample:
    t: float
    link: str
    up: bool
    queued_messages: int
    totals: ThinLinkTotals


@dataclass(frozen=True, slots=True)
class ThinPeerSample:
    """Whether a node is heard on thin links, and hears this one."""

    t: float
    peer: str
    present: bool


@dataclass(slots=True)
class ThinLinkUse:
    """A thin link during the recording."""

    first: ThinLinkSample
    last: ThinLinkSample
    samples: int = 0
    samples_up: int = 0
    most_queued: int = 0

    def add(self, sample: ThinLinkSample) -> float | None:
        """The next sample. The share of the time since the last one in which the link sent; None if no time passed."""
        passed_s = sample.t - self.last.t
        sent_s = sample.totals.airtime_s - self.last.totals.airtime_s
        self.last = sample
        self.samples += 1
        self.samples_up += sample.up
        self.most_queued = max(self.most_queued, sample.queued_messages)
        return max(0.0, sent_s) / passed_s if passed_s > 0 else None

    @property
    def totals(self) -> ThinLinkTotals:
        """Totals of the link during the recording."""
        return self.last.totals.since(self.first.totals)

    @property
    def up_share(self) -> float:
        """Share of the samples in which the port was open."""
        return self.samples_up / self.samples if self.samples else 0.0


_COUNTERS = tuple(field.name for field in fields(ThinLinkTotals) if field.name != "airtime_s")


def thin_items(t: float, entry: object) -> Iterator[ThinLinkSample | ThinPeerSample]:
    """Samples of thin links in the conditions at `t`. Raises UnreadableError."""
    if not isinstance(entry, dict):
        raise UnreadableError("an object as thin", entry)
    for row in rows(entry, "links"):
        totals = ThinLinkTotals(
            number(row, "airtime_s", 0.0, MAX_AIRTIME_S), *(integer(row, name) for name in _COUNTERS)
        )
        yield ThinLinkSample(t, text(row, "name"), _flag(row, "up"), integer(row, "queued_messages"), totals)
    for row in rows(entry, "peers"):
        yield ThinPeerSample(t, text(row, "name"), _flag(row, "present"))


def _flag(row: dict[str, Any], key: str) -> bool:
    value = row.get(key)
    if not isinstance(value, bool):
        raise UnreadableError(f"true or false as {key}", value)
    return value
