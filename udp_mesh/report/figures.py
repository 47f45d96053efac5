"""A recording's numbers: intervals between messages, time online, throughput by topic, outcomes, links. `summary`
returns them for scripts."""

from __future__ import annotations

import itertools
import math
from collections import defaultdict
from dataclasses import asdict, dataclass
from typing import Any

from udp_mesh.report.recording import Recording, VersionTotals

# A periodic topic has enough messages, and a median interval that most of them keep to.
_MIN_MESSAGES = 20
_PUNCTUAL_SHARE = 0.05


@dataclass(frozen=True, slots=True)
class Intervals:
    """Intervals between consecutive arrivals of one topic from one source. `deviation_s` is the standard deviation of
    those within 0.5 to 1.5 times the median, since a gap while a robot is out of range is not jitter; `gaps` counts the
    others. `punctual` is the share of all intervals within 5 % of the median, the paper's measure."""

    source: str
    topic: str
    values_s: tuple[float, ...]
    median_s: float
    deviation_s: float
    gaps: int
    punctual: float


@dataclass(frozen=True, slots=True)
class Connection:
    """When a peer was online: (from, to) in seconds; `share` of the time from its first appearance to the end."""

    peer: str
    spans_s: tuple[tuple[float, float], ...]
    share: float


@dataclass(frozen=True, slots=True)
class Throughput:
    """Bits per second of one topic in each of the equal `bins` of `width_s`."""

    topic: str
    priority: int
    total_bytes: int
    messages: int
    bits_per_s: tuple[float, ...]


def intervals(recording: Recording) -> list[Intervals]:
    """Intervals of every (source, topic) with enough messages, most messages first."""
    arrived: dict[tuple[str, str], list[float]] = defaultdict(list)
    for item in recording.arrivals:
        arrived[item.source, item.topic].append(item.t)
    found = []
    for (source, topic), times in arrived.items():
        if len(times) < _MIN_MESSAGES:
            continue
        values = [later - earlier for earlier, later in itertools.pairwise(sorted(times))]
        median_s = sorted(values)[len(values) // 2]
        if median_s <= 0.0:
            # Most arrived at once: not periodic.
            continue
        near = [value for value in values if 0.5 * median_s <= value <= 1.5 * median_s]
        mean_s = sum(near) / len(near) if near else 0.0
        deviation_s = math.sqrt(sum((value - mean_s) ** 2 for value in near) / len(near)) if near else 0.0
        punctual = sum(abs(value - median_s) <= _PUNCTUAL_SHARE * median_s for value in values) / len(values)
        found.append(Intervals(source, topic, tuple(values), median_s, deviation_s, len(values) - len(near), punctual))
    return sorted(found, key=lambda each: (-len(each.values_s), each.source, each.topic))


def connections(recording: Recording) -> list[Connection]:
    """Connections of every peer that was ever online, by name."""
    end_s = recording.end_s
    spans: dict[str, list[tuple[float, float]]] = defaultdict(list)
    since: dict[str, float] = {}
    for item in recording.presences:
        if item.online:
            since.setdefault(item.peer, item.t)
        elif item.peer in since:
            spans[item.peer].append((since.pop(item.peer), item.t))
    for peer, start_s in since.items():
        spans[peer].append((start_s, end_s))
    found = []
    for peer, times in sorted(spans.items()):
        whole_s = end_s - times[0][0]
        share = sum(stop - start for start, stop in times) / whole_s if whole_s > 0 else 1.0
        found.append(Connection(peer, tuple(times), share))
    return found


def throughput(recording: Recording, bins: int = 120, width_s: float | None = None) -> tuple[float, list[Throughput]]:
    """(bin width in seconds, throughput of every topic, most urgent first). Without `width_s` the bins end with the
    recording."""
    width_s = width_s or max(recording.end_s / bins, 1e-9)
    filled: dict[str, list[float]] = defaultdict(lambda: [0.0] * bins)
    totals: dict[str, list[int]] = defaultdict(lambda: [0, 0, 0])
    for item in recording.arrivals:
        filled[item.topic][min(bins - 1, int(item.t / width_s))] += item.size * 8 / width_s
        total = totals[item.topic]
        total[0], total[1], total[2] = item.priority, total[1] + item.size, total[2] + 1
    found = [
        Throughput(topic, priority, size, count, tuple(filled[topic]))
        for topic, (priority, size, count) in totals.items()
    ]
    return width_s, sorted(found, key=lambda each: (each.priority, each.topic))


@dataclass(frozen=True, slots=True)
class SentTopic:
    """What this node sent of one topic, and the outcomes. Outcomes count destinations; a single-datagram broadcast has
    none. `latencies_s` are those of delivered messages, ascending."""

    topic: str
    messages: int
    total_bytes: int
    delivered: int
    expired: int
    peer_lost: int
    latencies_s: tuple[float, ...]

    def latency_s(self, share: float) -> float | None:
        """The latency that this share of the delivered messages did not exceed; None if there were none."""
        if not self.latencies_s:
            return None
        return self.latencies_s[min(len(self.latencies_s) - 1, int(share * len(self.latencies_s)))]


def differences(recording: Recording) -> list[tuple[str, VersionTotals]]:
    """What each topic with `delta` sent during the recording, by topic."""
    spans = ((topic, last.since(first)) for topic, (first, last) in sorted(recording.versions.items()))
    return [(topic, totals) for topic, totals in spans if totals.whole or totals.differences]


def saved(recording: Recording) -> list[tuple[str, int, int]]:
    """By peer, the messages and bytes not sent to it during the recording, because no program there wants them."""
    spans = (
        (peer, last.messages - first.messages, last.bytes - first.bytes)
        for peer, (first, last) in sorted(recording.saved.items())
    )
    return [(peer, messages, size) for peer, messages, size in spans if messages > 0]


def sent_topics(recording: Recording) -> list[SentTopic]:
    """Every topic with sent messages or outcomes, most urgent first."""
    counts: dict[str, list[int]] = defaultdict(lambda: [0, 0])
    ends: dict[str, dict[str, int]] = defaultdict(lambda: defaultdict(int))
    latencies: dict[str, list[float]] = defaultdict(list)
    priorities: dict[str, int] = {}
    for item in recording.sent:
        counts[item.topic][0] += 1
        counts[item.topic][1] += item.size
        priorities[item.topic] = item.priority
    for outcome in recording.outcomes:
        ends[outcome.topic][outcome.kind] += 1
        if outcome.latency_s is not None:
            latencies[outcome.topic].append(outcome.latency_s)
    return [
        SentTopic(
            topic,
            counts[topic][0],
            counts[topic][1],
            ends[topic]["delivered"],
            ends[topic]["expired"],
            ends[topic]["peer-lost"],
            tuple(sorted(latencies[topic])),
        )
        for topic in sorted({*counts, *ends}, key=lambda topic: (priorities.get(topic, 99), topic))
    ]


def summary(recording: Recording) -> dict[str, Any]:
    """All numbers of the page, as JSON values."""
    _, received = throughput(recording)
    return {
        "node": recording.name,
        "started": recording.started,
        "seconds": recording.end_s,
        "lines_unreadable": len(recording.problems),
        "lines_left_out": recording.missing_lines,
        "received": [
            {"topic": each.topic, "priority": each.priority, "messages": each.messages, "bytes": each.total_bytes}
            for each in received
        ],
        "sent": [
            {
                "topic": each.topic,
                "messages": each.messages,
                "bytes": each.total_bytes,
                "delivered": each.delivered,
                "expired": each.expired,
                "peer_lost": each.peer_lost,
                "latency_p50_s": each.latency_s(0.5),
                "latency_p99_s": each.latency_s(0.99),
            }
            for each in sent_topics(recording)
        ],
        "differences": [
            {
                "topic": topic,
                "whole": totals.whole,
                "differences": totals.differences,
                "payload_bytes": totals.payload_bytes,
                "body_bytes": totals.body_bytes,
            }
            for topic, totals in differences(recording)
        ],
        "saved": [{"peer": peer, "messages": messages, "bytes": size} for peer, messages, size in saved(recording)],
        "logs": [
            {"topic": topic, "source": source, **asdict(progress)}
            for (topic, source), progress in sorted(recording.logs.items())
        ],
        "online": [
            {"peer": each.peer, "share": round(each.share, 6), "spans_s": [list(span) for span in each.spans_s]}
            for each in connections(recording)
        ],
        "intervals": [
            {
                "source": each.source,
                "topic": each.topic,
                "median_s": each.median_s,
                "deviation_s": each.deviation_s,
                "gaps": each.gaps,
                "within_5_percent": round(each.punctual, 6),
            }
            for each in intervals(recording)
        ],
    }


def histogram(values: tuple[float, ...], low: float, high: float, bins: int = 60) -> list[float]:
    """The density of the values between two bounds; values outside are not drawn but count in the normalization."""
    counts = [0] * bins
    width = (high - low) / bins
    for value in values:
        if low <= value < high:
            counts[min(bins - 1, int((value - low) / width))] += 1
    return [count / (len(values) * width) if values else 0.0 for count in counts]
