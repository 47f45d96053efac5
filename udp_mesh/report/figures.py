"""A recording's numbers: intervals between messages, time online, throughput by topic."""

from __future__ import annotations

import itertools
import math
from collections import defaultdict
from dataclasses import dataclass

from udp_mesh.report.recording import Recording

# what counts as a periodic topic: enough messages, with a middle interval that most keep to
_LEAST_MESSAGES = 20


@dataclass(frozen=True, slots=True)
class Intervals:
    """Between consecutive arrivals of one topic from one source. `deviation_s` is the standard deviation of those
    within half and one and a half of the median: a gap while a robot is out of reach is no jitter; `gaps` counts what
    lies outside."""

    source: str
    topic: str
    values_s: tuple[float, ...]
    median_s: float
    deviation_s: float
    gaps: int


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
    """Of every (source, topic) with enough messages, the most regular first."""
    arrived: dict[tuple[str, str], list[float]] = defaultdict(list)
    for item in recording.arrivals:
        arrived[item.source, item.topic].append(item.t)
    found = []
    for (source, topic), times in arrived.items():
        if len(times) < _LEAST_MESSAGES:
            continue
        values = [later - earlier for earlier, later in itertools.pairwise(times)]
        median_s = sorted(values)[len(values) // 2]
        near = [value for value in values if 0.5 * median_s <= value <= 1.5 * median_s]
        mean_s = sum(near) / len(near) if near else 0.0
        deviation_s = math.sqrt(sum((value - mean_s) ** 2 for value in near) / len(near)) if near else 0.0
        found.append(Intervals(source, topic, tuple(values), median_s, deviation_s, len(values) - len(near)))
    return sorted(found, key=lambda each: (each.deviation_s / max(each.median_s, 1e-9), each.source, each.topic))


def connections(recording: Recording) -> list[Connection]:
    """Of every peer that was ever online, by name."""
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


def throughput(recording: Recording, bins: int = 120) -> tuple[float, list[Throughput]]:
    """(width of a bin in seconds, throughput of every topic, the most urgent first)."""
    width_s = max(recording.end_s / bins, 1e-9)
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


def histogram(values: tuple[float, ...], low: float, high: float, bins: int = 60) -> list[float]:
    """The density of the values between two bounds; what lies outside is left out of the picture, not of the count."""
    counts = [0] * bins
    width = (high - low) / bins
    for value in values:
        if low <= value < high:
            counts[min(bins - 1, int((value - low) / width))] += 1
    return [count / (len(values) * width) if values else 0.0 for count in counts]
