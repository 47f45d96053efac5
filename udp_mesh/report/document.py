"""A recording as one document of bounded size: tables, charts, events, spans, tracks. The page and the text show it.

All values are JSON. Times are Unix seconds; names and texts come from other machines and are to be shown as text.

    {"version": 1, "node", "started_s", "seconds", "notes": [TEXT],
     "tables": [{"title", "columns": [{"label", "is_number"}], "rows": [[TEXT]], "note"}],
     "charts": [{"title", "unit", "kind": "lines" | "stacked", "note", "times_s": [...],
                 "series": [{"label", "values", "low"?, "high"?}]}],
     "histograms": [{"title", "unit", "low", "high", "bars", "mean", "deviation", "note"}],
     "spans": {"title", "note", "rows": [{"label", "spans_s": [[from, to]]}]},
     "events": [{"time_s", "at", "kind", "text"}],
     "tracks": [{"name", "points": [[time_s, x_m, y_m, is_online]]}]}
"""

from __future__ import annotations

from bisect import bisect_right
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from udp_mesh.report import figures
from udp_mesh.report.bins import BinnedLines, Bins, largest, rounded, thinned
from udp_mesh.report.recording import Recording, Sample

VERSION = 1
BINS = 240
"""About one per two pixels of a chart."""
MAX_LINES = 12
MAX_LAYERS = 8
MAX_SPANS = 500
MAX_EVENTS = 1000
MAX_POINTS = 1000
MAX_HISTOGRAMS = 4
PAPER_DEVIATION_S = 0.04
"""The standard deviation of the intervals in the paper that the transport follows, as a share of the median."""
_SHOWN_SPREAD = 0.25
"""Range shown on either side of the median, as a share of it: six of the paper's deviations."""
MISSING = "–"
_SAMPLED: tuple[tuple[str, str, Callable[[Sample], float | None]], ...] = (
    ("Round-trip time", "ms", lambda sample: _scaled(sample.round_trip_s, 1e3)),
    ("Loss to the peer", "%", lambda sample: _scaled(sample.loss, 100)),
    ("Received from the peer", "Mbit/s", lambda sample: _scaled(sample.received_bits_per_s, 1e-6)),
    ("Capacity to the peer", "Mbit/s", lambda sample: _scaled(sample.capacity_bits_per_s, 1e-6)),
    ("Outbox for the peer", "messages", lambda sample: sample.outbox_messages),
    ("Hops to the peer", "hops", lambda sample: sample.hops),
)


def document_of(recording: Recording) -> dict[str, Any]:
    """The document of a recording."""
    bins = Bins.at_most(BINS, recording.end_s)
    return {
        "version": VERSION,
        "node": recording.name,
        "started_s": recording.started,
        "seconds": round(recording.end_s, 3),
        "notes": _notes(recording),
        "tables": [table for table in (*_message_tables(recording), *_state_tables(recording)) if table["rows"]],
        "charts": [chart for chart in _charts(recording, bins) if chart["series"]],
        "histograms": [_histogram(each) for each in figures.intervals(recording)[:MAX_HISTOGRAMS]],
        "spans": _spans(recording, bins),
        "events": _events(recording),
        "tracks": _tracks(recording),
    }


def _notes(recording: Recording) -> list[str]:
    total_mb = sum(item.size for item in recording.arrivals) / 1e6
    notes = [f"{recording.end_s:.0f} s, {len(recording.arrivals)} messages received, {total_mb:.1f} MB."]
    if recording.problems:
        notes.append(f"Invalid lines, which were ignored: {len(recording.problems)}.")
    if recording.missing_lines:
        notes.append(
            f"The disk did not keep up with the recording: {recording.missing_lines} lines are missing and not counted."
        )
    return notes


def _table(title: str, columns: str, rows: Iterable[Sequence[str]], note: str = "") -> dict[str, Any]:
    """`columns` are labels separated by `|`; those that begin with `#` are of numbers."""
    heads = [{"label": label.lstrip("#"), "is_number": label.startswith("#")} for label in columns.split("|")]
    return {"title": title, "columns": heads, "rows": [list(row) for row in rows], "note": note}


def _message_tables(recording: Recording) -> list[dict[str, Any]]:
    _, received = figures.throughput(recording)
    return [
        _table(
            "Received",
            "topic|#priority|#messages|#MB",
            (
                (each.topic, str(each.priority), str(each.messages), f"{each.total_bytes / 1e6:.2f}")
                for each in received
            ),
        ),
        _table(
            "Sent",
            "topic|#messages|#MB|#delivered|#expired|#peer lost|#p50 ms|#p99 ms",
            (
                (
                    *(each.topic, str(each.messages), f"{each.total_bytes / 1e6:.2f}", str(each.delivered)),
                    *(str(each.expired), str(each.peer_lost)),
                    *(_milliseconds(each.latency_s(share)) for share in (0.5, 0.99)),
                )
                for each in figures.sent_topics(recording)
            ),
            "Outcomes count destinations; a single-datagram broadcast has none. Latency is measured from sending to "
            "the acknowledgment.",
        ),
        _table(
            "Differences sent",
            "topic|#whole|#differences|#MB|#MB on the wire|#saved",
            (
                (
                    *(topic, str(totals.whole), str(totals.differences)),
                    *(f"{size / 1e6:.2f}" for size in (totals.payload_bytes, totals.body_bytes)),
                    _saved(totals.payload_bytes, totals.body_bytes),
                )
                for topic, totals in figures.differences(recording)
            ),
            "On the wire: without headers and retransmissions, once for each destination.",
        ),
        _table(
            "Not sent",
            "peer|#messages|#MB",
            ((peer, str(messages), f"{size / 1e6:.2f}") for peer, messages, size in figures.saved(recording)),
            "No program at the peer reads the topic, or wants it that often or that old.",
        ),
    ]


def _saved(payload_bytes: int, body_bytes: int) -> str:
    return MISSING if payload_bytes <= 0 else f"{1 - body_bytes / payload_bytes:.0%}"


def _state_tables(recording: Recording) -> list[dict[str, Any]]:
    counts: dict[tuple[str, str], int] = defaultdict(int)
    for event in recording.events:
        counts[event.at, event.kind] += 1
    return [
        _table(
            "Online",
            "peer|#share of the time|#times lost|#longest gap s",
            (
                (each.peer, f"{each.share:.1%}", str(len(gaps)), f"{max(gaps):.1f}" if gaps else MISSING)
                for each in figures.connections(recording)
                for gaps in (_gaps(each, recording.end_s),)
            ),
            "Of the time since the peer was first seen.",
        ),
        _table(
            "Intervals between messages",
            "source|topic|#intervals|#median s|#deviation s|#gaps|#within 5 %",
            (
                (
                    *(each.source, each.topic, str(len(each.values_s)), f"{each.median_s:.3f}"),
                    *(f"{each.deviation_s:.4f}", str(each.gaps), f"{each.punctual:.1%}"),
                )
                for each in figures.intervals(recording)
            ),
            "Deviation: of the intervals within 0.5 to 1.5 times the median; gaps are the others.",
        ),
        _table(
            "Shared logs at the end",
            "log|source|#items received|#MB on disk",
            (
                (*(topic, source), f"{log.received_items} of {log.known_items}", f"{log.held_bytes / 1e6:.2f}")
                for (topic, source), log in sorted(recording.logs.items())
            ),
        ),
        _table("Events", "node|event|#times", ((at, kind, str(count)) for (at, kind), count in sorted(counts.items()))),
    ]


def _gaps(connection: figures.Connection, end_s: float) -> list[float]:
    starts = [start for start, _ in connection.spans_s[1:]] + [end_s]
    return [start - stop for (_, stop), start in zip(connection.spans_s, starts, strict=True) if start > stop]


def _milliseconds(seconds: float | None) -> str:
    return MISSING if seconds is None else f"{seconds * 1e3:.1f}"


def _scaled(value: float | None, factor: float) -> float | None:
    return None if value is None else value * factor


def _charts(recording: Recording, bins: Bins) -> list[dict[str, Any]]:
    started_s = recording.started

    def chart(title: str, unit: str, kind: str, series: list[dict[str, Any]], note: str) -> dict[str, Any]:
        times_s = bins.times_s(started_s) if series else []
        return {"title": title, "unit": unit, "kind": kind, "note": note, "times_s": times_s, "series": series}

    def lines(title: str, unit: str, points: Iterable[tuple[str, float, float | None]]) -> dict[str, Any]:
        gathered = BinnedLines(bins)
        for label, t, value in points:
            if value is not None:
                gathered.add(label, t, value)
        labels, count = gathered.labels(MAX_LINES)
        note = f"Mean of each {bins.width_s:.3g} s; shaded from the least to the greatest value in it."
        if count > len(labels):
            note += f" The {len(labels)} of {count} with the greatest values."
        return chart(title, unit, "lines", gathered.series(labels), note)

    _, received = figures.throughput(recording, bins.count, bins.width_s)
    note = f"Received, mean of each {bins.width_s:.3g} s."
    by_topic = {each.topic: each.bits_per_s for each in received}
    by_priority: dict[str, list[float]] = {}
    for each in received:
        total = by_priority.setdefault(f"priority {each.priority}", [0.0] * bins.count)
        for place, value in enumerate(each.bits_per_s):
            total[place] += value
    samples = recording.samples
    return [
        chart("Throughput by topic", "Mbit/s", "stacked", _layers(by_topic), note),
        chart("Throughput by priority", "Mbit/s", "stacked", _layers(by_priority), note),
        lines(
            "Latency to the acknowledgment",
            "ms",
            ((item.topic, item.t, _scaled(item.latency_s, 1e3)) for item in recording.outcomes),
        ),
        *(
            lines(title, unit, ((sample.peer, sample.t, value_of(sample)) for sample in samples))
            for title, unit, value_of in _SAMPLED
        ),
    ]


def _layers(values: Mapping[str, Sequence[float]]) -> list[dict[str, Any]]:
    """In Mbit/s, in the order given; the smallest of too many are one layer, so that every bit is counted."""
    shown = set(largest({name: sum(each) for name, each in values.items()}, MAX_LAYERS))
    layers = {name: list(each) for name, each in values.items() if name in shown}
    others = [each for name, each in values.items() if name not in shown]
    if others:
        layers[f"{len(others)} others"] = [sum(column) for column in zip(*others, strict=True)]
    # the most urgent at the bottom
    return [
        {"label": name, "values": [rounded(value / 1e6) for value in each]} for name, each in reversed(layers.items())
    ]


def _histogram(each: figures.Intervals) -> dict[str, Any]:
    low, high = (1 - _SHOWN_SPREAD) * each.median_s, (1 + _SHOWN_SPREAD) * each.median_s
    return {
        "title": f"Interval between messages: {each.topic} from {each.source}",
        "unit": "s",
        "low": low,
        "high": high,
        "bars": [rounded(value) for value in figures.histogram(each.values_s, low, high)],
        "mean": each.median_s,
        "deviation": PAPER_DEVIATION_S * each.median_s,
        "note": f"{len(each.values_s)} intervals, median {each.median_s:.3f} s, {each.punctual:.1%} of them within 5 % "
        f"of it; standard deviation {each.deviation_s:.4f} s within 0.5 to 1.5 times the median; outside: {each.gaps}. "
        f"The curve is a normal distribution with a deviation of {PAPER_DEVIATION_S:.0%} of the median.",
    }


def _spans(recording: Recording, bins: Bins) -> dict[str, Any]:
    rows = []
    note = ""
    for each in figures.connections(recording):
        spans = list(each.spans_s)
        if len(spans) > MAX_SPANS:
            spans = _merged(spans, bins.width_s)
            note = (
                f"Of peers that came and went more than {MAX_SPANS} times, gaps below {bins.width_s:.3g} s are closed."
            )
        rows.append(
            {"label": each.peer, "spans_s": [[round(recording.started + t, 3) for t in span] for span in spans]}
        )
    return {"title": "Online", "note": note, "rows": rows}


def _merged(spans: Sequence[tuple[float, float]], gap_s: float) -> list[tuple[float, float]]:
    """Without gaps that are shorter."""
    merged = [spans[0]]
    for start, stop in spans[1:]:
        if start - merged[-1][1] < gap_s:
            merged[-1] = (merged[-1][0], stop)
        else:
            merged.append((start, stop))
    return merged


def _events(recording: Recording) -> list[dict[str, Any]]:
    """Evenly thinned; the table counts them all."""
    return [
        {"time_s": round(recording.started + event.t, 3), "at": event.at, "kind": event.kind, "text": event.text}
        for event in thinned(recording.events, MAX_EVENTS)
    ]


def _tracks(recording: Recording) -> list[dict[str, Any]]:
    """Each node's way, and whether the recording node had it online there; of the recording node, whether any was."""
    spans = {each.peer: each.spans_s for each in figures.connections(recording)}
    everyone = sorted(span for each in spans.values() for span in each)
    spans.setdefault(recording.name, tuple(_merged(everyone, 0.0)) if everyone else ())
    points: dict[str, list[list[Any]]] = defaultdict(list)
    for place in recording.places:
        track = points[place.at]
        is_online = _is_within(spans.get(place.at, ()), place.t)
        if not track or track[-1][1:] != [place.x, place.y, is_online]:
            track.append([round(recording.started + place.t, 3), place.x, place.y, is_online])
    return [
        {"name": name, "points": thinned(track, MAX_POINTS)} for name, track in sorted(points.items()) if len(track) > 1
    ]


def _is_within(spans: Sequence[tuple[float, float]], t: float) -> bool:
    index = bisect_right(spans, (t, float("inf"))) - 1
    return index >= 0 and t <= spans[index][1]
