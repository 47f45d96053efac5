"""A recording in bounded memory: each line is counted as it is read, and kept only where a limit allows it.

`read` -> `Recording`: totals, points in bins, distributions, time online, events and tracks. Hours of a large team are
gigabytes of lines; none of the limits below is met by a team of a hundred robots, and what exceeds one is counted.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from udp_mesh.report.bins import BinnedLines, Thinned
from udp_mesh.report.distribution import Distribution
from udp_mesh.report.radio_paths import RadioPathUse, RadioSample
from udp_mesh.report.recording import (
    Gap,
    InvalidLine,
    Item,
    LogProgress,
    LogSample,
    Place,
    Presence,
    RecordedArrival,
    RecordedEvent,
    RecordingError,
    RecordingReader,
    Sample,
    SavedSample,
    SavedTotals,
    SentMessage,
    SentOutcome,
    Snapshot,
    VersionSample,
    VersionTotals,
    lines_of,
)
from udp_mesh.report.thin_links import ThinLinkSample, ThinLinkUse, ThinPeerSample

BINS = 240
"""Of a chart: about one per two pixels."""
MAX_NAMES = 1024
"""Topics, peers, sources and kinds, each: others of a damaged or hostile recording are counted as `unnamed`."""
MAX_SPANS = 500
"""Times that a peer is shown as online; then short gaps are closed."""
MAX_EVENTS = 1000
MAX_POINTS = 1000
"""Of a track."""
MAX_EVENT_KINDS = 64
MAX_PROBLEMS = 100
OTHER_KINDS = "other"
SAMPLED: tuple[tuple[str, float], ...] = (
    ("round_trip_s", 1e3),
    ("loss", 100),
    ("received_bits_per_s", 1e-6),
    ("capacity_bits_per_s", 1e-6),
    ("outbox_messages", 1),
    ("hops", 1),
)
"""The fields of a sample that become charts, and the factor to the chart's unit."""
RADIO_SAMPLED: tuple[tuple[str, float], ...] = (("margin_db", 1), ("signal_dbm", 1), ("bottleneck_bits_per_s", 1e-6))
"""Likewise of a radio sample."""


@dataclass(slots=True)
class ReceivedTopic:
    """Messages received of one topic."""

    priority: int = 0
    messages: int = 0
    total_bytes: int = 0


@dataclass(slots=True)
class SentTopic:
    """Messages that this node sent of one topic, and the outcomes, which count destinations; a single-datagram
    broadcast has none. `latencies_s` are those of delivered messages."""

    priority: int | None = None
    messages: int = 0
    total_bytes: int = 0
    outcomes: dict[str, int] = field(default_factory=lambda: {"delivered": 0, "expired": 0, "peer-lost": 0})
    latencies_s: Distribution = field(default_factory=Distribution)


@dataclass(slots=True)
class Arrivals:
    """The intervals between consecutive arrivals of one topic from one source."""

    last_s: float
    intervals_s: Distribution = field(default_factory=Distribution)


@dataclass(slots=True)
class OnlineTimes:
    """When a peer was online. `spans_s` are (from, to); of very many, gaps below `closed_gap_s` are closed. `online_s`,
    `times_lost` and `longest_gap_s` count every one."""

    first_s: float
    since_s: float | None = None
    spans_s: list[tuple[float, float]] = field(default_factory=list)
    closed_gap_s: float = 0.0
    online_s: float = 0.0
    times_lost: int = 0
    longest_gap_s: float = 0.0
    last_stop_s: float | None = None

    def begin(self, t: float) -> None:
        if self.since_s is not None:
            return
        if self.last_stop_s is not None and t > self.last_stop_s:
            self.times_lost += 1
            self.longest_gap_s = max(self.longest_gap_s, t - self.last_stop_s)
        self.since_s = t

    def stop(self, t: float) -> None:
        if self.since_s is None:
            return
        self.spans_s.append((self.since_s, t))
        self.online_s += t - self.since_s
        self.since_s, self.last_stop_s = None, t
        if len(self.spans_s) > 2 * MAX_SPANS:
            # at most one gap per bin is left
            self.close_gaps(t / BINS)

    def close_gaps(self, shorter_than_s: float) -> None:
        self.closed_gap_s = shorter_than_s
        self.spans_s = without_gaps(self.spans_s, shorter_than_s)

    def end(self, end_s: float) -> None:
        if self.since_s is not None:
            self.stop(end_s)
        elif self.last_stop_s is not None and end_s > self.last_stop_s:
            self.times_lost += 1
            self.longest_gap_s = max(self.longest_gap_s, end_s - self.last_stop_s)


@dataclass(slots=True)
class Recording:
    """`problems` are the first invalid lines and why, of `invalid_lines`; `missing_lines` were dropped during
    recording; `unnamed` values were left out because they exceed MAX_NAMES."""

    name: str = ""
    started: float = 0.0
    end_s: float = 0.0
    """The latest time of a line."""
    received: dict[str, ReceivedTopic] = field(default_factory=dict)
    sent: dict[str, SentTopic] = field(default_factory=dict)
    arrivals: dict[tuple[str, str], Arrivals] = field(default_factory=dict)
    """By source and topic."""
    online: dict[str, OnlineTimes] = field(default_factory=dict)
    versions: dict[str, tuple[VersionTotals, VersionTotals]] = field(default_factory=dict)
    """By topic: at the beginning of the recording, and last."""
    logs: dict[tuple[str, str], LogProgress] = field(default_factory=dict)
    """By topic and source."""
    saved: dict[str, tuple[SavedTotals, SavedTotals]] = field(default_factory=dict)
    """By peer: at the beginning of the recording, and last."""
    thin_links: dict[str, ThinLinkUse] = field(default_factory=dict)
    thin_present: dict[str, OnlineTimes] = field(default_factory=dict)
    """By peer: when it was heard on thin links, and heard this node."""
    thin_airtime: BinnedLines = field(default_factory=lambda: BinnedLines(BINS))
    """By link: the share of the time in which it sent, in percent."""
    radio_paths: dict[str, RadioPathUse] = field(default_factory=dict)
    """By peer."""
    event_counts: dict[tuple[str, str], int] = field(default_factory=dict)
    """By node and kind."""
    events: dict[str, Thinned[RecordedEvent]] = field(default_factory=dict)
    """By kind, so that a rare kind is not thinned with a frequent one."""
    tracks: dict[str, Thinned[tuple[float, float, float, bool]]] = field(default_factory=dict)
    """By node: time, x, y, and whether the recording node had it online; of the recording node, whether any was."""
    received_bytes: BinnedLines = field(default_factory=lambda: BinnedLines(BINS))
    latencies_ms: BinnedLines = field(default_factory=lambda: BinnedLines(BINS))
    sampled: dict[str, BinnedLines] = field(default_factory=lambda: {name: BinnedLines(BINS) for name, _ in SAMPLED})
    """By field of a sample; one line per peer, in the unit of its chart."""
    radio_sampled: dict[str, BinnedLines] = field(
        default_factory=lambda: {name: BinnedLines(BINS) for name, _ in RADIO_SAMPLED}
    )
    """Likewise of a radio sample."""
    snapshots: int = 0
    """Lines with conditions."""
    missing_lines: int = 0
    invalid_lines: int = 0
    unnamed: int = 0
    problems: list[str] = field(default_factory=list)
    _last_places: dict[str, tuple[float, float, bool]] = field(default_factory=dict)
    _online_now: int = 0

    @property
    def messages(self) -> int:
        return sum(each.messages for each in self.received.values())

    def add(self, item: Item) -> None:
        """The next item."""
        if not isinstance(item, VersionSample | LogSample | SavedSample | InvalidLine):
            self.end_s = max(self.end_s, item.t)
        match item:
            case RecordedArrival():
                self._arrived(item)
            case Sample():
                for name, factor in SAMPLED:
                    if (value := getattr(item, name)) is not None:
                        self.sampled[name].add(item.peer, item.t, value * factor)
            case SentMessage():
                self._sent(item)
            case SentOutcome():
                self._ended(item)
            case Presence():
                self._presence(item)
            case Place():
                self._place(item)
            case RecordedEvent():
                self._event(item)
            case Snapshot():
                self.snapshots += 1
            case VersionSample(topic, totals):
                # A topic that is first seen later was unused at the beginning.
                begin = VersionTotals() if self.snapshots > 1 else totals
                if self._has_room(self.versions, topic):
                    self.versions[topic] = (self.versions.get(topic, (begin, totals))[0], totals)
            case SavedSample(peer, saved):
                # A peer that is first seen later was sent nothing before.
                start = SavedTotals() if self.snapshots > 1 else saved
                if self._has_room(self.saved, peer):
                    self.saved[peer] = (self.saved.get(peer, (start, saved))[0], saved)
            case LogSample(topic, source, progress):
                if self._has_room(self.logs, (topic, source)):
                    self.logs[topic, source] = progress
            case ThinLinkSample():
                self._thin_link(item)
            case ThinPeerSample(t, peer, present):
                self._mark(self.thin_present, peer, t, is_there=present)
            case RadioSample():
                self._radio_path(item)
            case Gap():
                self.missing_lines += item.lines
            case InvalidLine(text):
                self.invalid_lines += 1
                if len(self.problems) < MAX_PROBLEMS:
                    self.problems.append(text)

    def end(self) -> None:
        """After the last item."""
        for times in (*self.online.values(), *self.thin_present.values()):
            times.end(self.end_s)

    def _has_room(self, known: Mapping[Any, object], key: Hashable) -> bool:
        if key in known or len(known) < MAX_NAMES:
            return True
        self.unnamed += 1
        return False

    def _thin_link(self, sample: ThinLinkSample) -> None:
        use = self.thin_links.get(sample.link)
        if use is None:
            if not self._has_room(self.thin_links, sample.link):
                return
            use = self.thin_links[sample.link] = ThinLinkUse(sample, sample)
        share = use.add(sample)
        if share is not None:
            self.thin_airtime.add(sample.link, sample.t, 100 * share)

    def _radio_path(self, sample: RadioSample) -> None:
        if not self._has_room(self.radio_paths, sample.peer):
            return
        self.radio_paths.setdefault(sample.peer, RadioPathUse()).add(sample)
        for name, factor in RADIO_SAMPLED:
            if (value := getattr(sample, name)) is not None:
                self.radio_sampled[name].add(sample.peer, sample.t, value * factor)

    def _arrived(self, item: RecordedArrival) -> None:
        topic = self.received.get(item.topic)
        if topic is None:
            if not self._has_room(self.received, item.topic):
                return
            topic = self.received[item.topic] = ReceivedTopic()
        topic.priority = item.priority
        topic.messages += 1
        topic.total_bytes += item.size
        self.received_bytes.add(item.topic, item.t, item.size)
        arrivals = self.arrivals.get((item.source, item.topic))
        if arrivals is not None:
            arrivals.intervals_s.add(max(0.0, item.t - arrivals.last_s))
            arrivals.last_s = item.t
        elif self._has_room(self.arrivals, (item.source, item.topic)):
            self.arrivals[item.source, item.topic] = Arrivals(item.t)

    def _sent_topic(self, name: str) -> SentTopic | None:
        if not self._has_room(self.sent, name):
            return None
        return self.sent.setdefault(name, SentTopic())

    def _sent(self, item: SentMessage) -> None:
        if (topic := self._sent_topic(item.topic)) is not None:
            topic.priority = item.priority
            topic.messages += 1
            topic.total_bytes += item.size

    def _ended(self, item: SentOutcome) -> None:
        if (topic := self._sent_topic(item.topic)) is None:
            return
        topic.outcomes[item.kind] += 1
        if item.latency_s is not None:
            topic.latencies_s.add(item.latency_s)
            self.latencies_ms.add(item.topic, item.t, item.latency_s * 1e3)

    def _presence(self, item: Presence) -> None:
        self._online_now += self._mark(self.online, item.peer, item.t, is_there=item.online)

    def _mark(self, known: dict[str, OnlineTimes], peer: str, t: float, *, is_there: bool) -> int:
        """Whether a peer is there from now on: 1 if it was not before, -1 if it was and is not any more, else 0."""
        times = known.get(peer)
        if times is None:
            if not is_there or not self._has_room(known, peer):
                return 0
            times = known[peer] = OnlineTimes(t)
        was_there = times.since_s is not None
        if is_there:
            times.begin(t)
        else:
            times.stop(t)
        return (times.since_s is not None) - was_there

    def _place(self, item: Place) -> None:
        track = self.tracks.get(item.at)
        if track is None:
            if not self._has_room(self.tracks, item.at):
                return
            track = self.tracks[item.at] = Thinned(MAX_POINTS)
        times = self.online.get(item.at)
        is_online = self._online_now > 0 if item.at == self.name else times is not None and times.since_s is not None
        last = (item.x, item.y, is_online)
        if self._last_places.get(item.at) != last:
            self._last_places[item.at] = last
            track.add((item.t, *last))

    def _event(self, item: RecordedEvent) -> None:
        if self._has_room(self.event_counts, (item.at, item.kind)):
            self.event_counts[item.at, item.kind] = self.event_counts.get((item.at, item.kind), 0) + 1
        kind = item.kind if item.kind in self.events or len(self.events) < MAX_EVENT_KINDS else OTHER_KINDS
        self.events.setdefault(kind, Thinned(MAX_EVENTS)).add(item)


def without_gaps(spans: Iterable[tuple[float, float]], shorter_than_s: float) -> list[tuple[float, float]]:
    """Ascending spans, with shorter gaps closed."""
    merged: list[tuple[float, float]] = []
    for start, stop in spans:
        if merged and start - merged[-1][1] < shorter_than_s:
            merged[-1] = (merged[-1][0], stop)
        else:
            merged.append((start, stop))
    return merged


def read(path: Path) -> Recording:
    """Reads a recording. Raises RecordingError if it is not one; a truncated or invalid line becomes a problem."""
    try:
        with path.open("rb") as file:
            return parse(lines_of(file), str(path))
    except OSError as error:
        raise RecordingError(f"{path}: cannot read: {error.strerror}") from error


def parse(lines: Iterable[bytes], file: str) -> Recording:
    """Like `read`, from the lines themselves."""
    reader = RecordingReader(lines, file)
    recording = Recording(reader.name, reader.started)
    for item in reader:
        recording.add(item)
    recording.end()
    return recording
