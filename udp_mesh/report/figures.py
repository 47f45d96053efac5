"""A recording's numbers: intervals between messages, time online, outcomes, differences. `summary` returns them for
scripts."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from udp_mesh.report.aggregate import OnlineTimes, ReceivedTopic, Recording, SentTopic
from udp_mesh.report.distribution import Distribution
from udp_mesh.report.recording import VersionTotals

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
    values_s: Distribution
    median_s: float
    deviation_s: float
    gaps: int
    punctual: float


def intervals(recording: Recording) -> list[Intervals]:
    """Intervals of every (source, topic) with enough messages, most messages first."""
    found = []
    for (source, topic), arrivals in recording.arrivals.items():
        values = arrivals.intervals_s
        if values.count < _MIN_MESSAGES - 1:
            continue
        median_s = values.quantile(0.5) or 0.0
        if median_s <= 0.0:
            # Most arrived at once: not periodic.
            continue
        near = [(value, times) for value, times in values.ascending() if 0.5 * median_s <= value <= 1.5 * median_s]
        count = sum(times for _, times in near)
        mean_s = sum(value * times for value, times in near) / count
        deviation_s = math.sqrt(sum(times * (value - mean_s) ** 2 for value, times in near) / count)
        punctual = sum(times for value, times in near if abs(value - median_s) <= _PUNCTUAL_SHARE * median_s)
        found.append(
            Intervals(source, topic, values, median_s, deviation_s, values.count - count, punctual / values.count)
        )
    return sorted(found, key=lambda each: (-each.values_s.count, each.source, each.topic))


def online_share(times: OnlineTimes, end_s: float) -> float:
    """The share of the time from a peer's first appearance to the end."""
    whole_s = end_s - times.first_s
    return times.online_s / whole_s if whole_s > 0 else 1.0


def received_topics(recording: Recording) -> list[tuple[str, ReceivedTopic]]:
    """Most urgent first."""
    return sorted(recording.received.items(), key=lambda item: (item[1].priority, item[0]))


def sent_topics(recording: Recording) -> list[tuple[str, SentTopic]]:
    """Every topic with sent messages or outcomes, most urgent first."""

    def order(item: tuple[str, SentTopic]) -> tuple[int, str]:
        topic, totals = item
        return 99 if totals.priority is None else totals.priority, topic

    return sorted(recording.sent.items(), key=order)


def differences(recording: Recording) -> list[tuple[str, VersionTotals]]:
    """Versions sent during the recording, by topic with `delta`."""
    spans = ((topic, last.since(first)) for topic, (first, last) in sorted(recording.versions.items()))
    return [(topic, totals) for topic, totals in spans if totals.whole or totals.differences]


def saved(recording: Recording) -> list[tuple[str, int, int]]:
    """By peer, the messages and bytes not sent to it during the recording, because no program there wants them."""
    spans = (
        (peer, last.messages - first.messages, last.bytes - first.bytes)
        for peer, (first, last) in sorted(recording.saved.items())
    )
    return [(peer, messages, size) for peer, messages, size in spans if messages > 0]


def summary(recording: Recording) -> dict[str, Any]:
    """All numbers of the page, as JSON values."""
    return {
        "node": recording.name,
        "started": recording.started,
        "seconds": recording.end_s,
        "lines_unreadable": recording.invalid_lines,
        "lines_left_out": recording.missing_lines,
        "received": [
            {"topic": topic, "priority": each.priority, "messages": each.messages, "bytes": each.total_bytes}
            for topic, each in received_topics(recording)
        ],
        "sent": [
            {
                "topic": topic,
                "messages": each.messages,
                "bytes": each.total_bytes,
                "delivered": each.outcomes["delivered"],
                "expired": each.outcomes["expired"],
                "peer_lost": each.outcomes["peer-lost"],
                "latency_p50_s": each.latencies_s.quantile(0.5),
                "latency_p99_s": each.latencies_s.quantile(0.99),
            }
            for topic, each in sent_topics(recording)
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
        "thin_links": [
            {
                "link": name,
                "seconds": round(use.last.t - use.first.t, 6),
                "up": round(use.up_share, 6),
                "most_queued": use.most_queued,
                **asdict(use.totals),
            }
            for name, use in sorted(recording.thin_links.items())
        ],
        "thin_present": _presence(recording.thin_present, recording.end_s),
        "radio_paths": [
            {
                "peer": peer,
                "samples": use.samples,
                "changes": use.changes,
                "mean_margin_db": None if use.mean_margin_db is None else round(use.mean_margin_db, 3),
                "least_margin_db": use.least_margin_db,
                "least_bottleneck_bits_per_s": use.least_bottleneck_bits_per_s,
                "worsening": round(use.worsening_share, 6),
            }
            for peer, use in sorted(recording.radio_paths.items())
        ],
        "online": _presence(recording.online, recording.end_s),
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


def _presence(peers: Mapping[str, OnlineTimes], end_s: float) -> list[dict[str, Any]]:
    return [
        {
            "peer": peer,
            "share": round(online_share(times, end_s), 6),
            "spans_s": [list(span) for span in times.spans_s],
        }
        for peer, times in sorted(peers.items())
    ]


def histogram(values: Distribution, low: float, high: float, bins: int = 60) -> list[float]:
    """The density of the values between two bounds; values outside are not drawn but count in the normalization."""
    counts = [0] * bins
    width = (high - low) / bins
    for value, times in values.ascending():
        if low <= value < high:
            counts[min(bins - 1, int((value - low) / width))] += times
    return [count / (values.count * width) if values.count else 0.0 for count in counts]
