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

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from udp_mesh.report import figures
from udp_mesh.report.aggregate import BINS, MAX_EVENTS, MAX_NAMES, MAX_SPANS, OnlineTimes, Recording
from udp_mesh.report.bins import BinnedLines, Bins, largest, rounded
from udp_mesh.report.radio_paths import RadioPathUse
from udp_mesh.report.recording import RecordedEvent
from udp_mesh.report.thin_links import ThinLinkUse

VERSION = 1
MAX_LINES = 12
MAX_LAYERS = 8
MAX_ROWS = 200
"""Of a table."""
MAX_HISTOGRAMS = 4
PAPER_DEVIATION_S = 0.04
"""The standard deviation of the intervals in the paper that the transport follows, as a share of the median."""
_SHOWN_SPREAD = 0.25
"""Range shown on either side of the median, as a share of it: six of the paper's deviations."""
MISSING = "–"
_SAMPLED: tuple[tuple[str, str, str], ...] = (
    ("round_trip_s", "Round-trip time", "ms"),
    ("loss", "Loss to the peer", "%"),
    ("received_bits_per_s", "Received from the peer", "Mbit/s"),
    ("capacity_bits_per_s", "Capacity to the peer", "Mbit/s"),
    ("outbox_messages", "Outbox for the peer", "messages"),
    ("hops", "Hops to the peer", "hops"),
)
_RADIO_SAMPLED: tuple[tuple[str, str, str], ...] = (
    ("margin_db", "Radio margin of the next hop to the peer", "dB"),
    ("signal_dbm", "Signal of the next hop to the peer", "dBm"),
    ("bottleneck_bits_per_s", "Bottleneck of the radio path to the peer", "Mbit/s"),
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
    total_mb = sum(each.total_bytes for each in recording.received.values()) / 1e6
    notes = [f"{recording.end_s:.0f} s, {recording.messages} messages received, {total_mb:.1f} MB."]
    if recording.invalid_lines:
        notes.append(f"Invalid lines, which were ignored: {recording.invalid_lines}.")
    if recording.missing_lines:
        notes.append(
            f"The disk did not keep up with the recording: {recording.missing_lines} lines are missing and not counted."
        )
    if recording.unnamed:
        notes.append(
            f"The recording has more than {MAX_NAMES} topics, peers or kinds of event; {recording.unnamed} values of "
            "further ones are not counted."
        )
    count = sum(kept.count for kept in recording.events.values())
    if count > MAX_EVENTS:
        notes.append(
            f"The list has {MAX_EVENTS} of {count} events: all of the rarest kinds, others evenly thinned. The table "
            "counts them all."
        )
    return notes


def _table(title: str, columns: str, rows: Iterable[Sequence[str]], note: str = "") -> dict[str, Any]:
    """`columns` are labels separated by `|`; those that begin with `#` are of numbers."""
    heads = [{"label": label.lstrip("#"), "is_number": label.startswith("#")} for label in columns.split("|")]
    shown = [list(row) for row in rows]
    if len(shown) > MAX_ROWS:
        note = f"{note} The first {MAX_ROWS} of {len(shown)} rows.".lstrip()
    return {"title": title, "columns": heads, "rows": shown[:MAX_ROWS], "note": note}


def _message_tables(recording: Recording) -> list[dict[str, Any]]:
    return [
        _table(
            "Received",
            "topic|#priority|#messages|#MB",
            (
                (topic, str(each.priority), str(each.messages), f"{each.total_bytes / 1e6:.2f}")
                for topic, each in figures.received_topics(recording)
            ),
        ),
        _table(
            "Sent",
            "topic|#messages|#MB|#delivered|#expired|#peer lost|#p50 ms|#p99 ms",
            (
                (
                    *(topic, str(each.messages), f"{each.total_bytes / 1e6:.2f}"),
                    *(str(each.outcomes[kind]) for kind in ("delivered", "expired", "peer-lost")),
                    *(_milliseconds(each.latencies_s.quantile(share)) for share in (0.5, 0.99)),
                )
                for topic, each in figures.sent_topics(recording)
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
    return [
        _table(
            "Online",
            "peer|#share of the time|#times lost|#longest gap s",
            (_online_row(peer, times, recording.end_s) for peer, times in sorted(recording.online.items())),
            "Of the time since the peer was first seen.",
        ),
        _table(
            "Thin links",
            "link|#port open|#airtime s|#share of the time|#frames sent|#kB sent|#frames received|#rejected"
            "|#parts repeated|#messages given up|#dropped|#most queued",
            (_thin_row(name, use) for name, use in sorted(recording.thin_links.items())),
            "Rejected: forged, or not opened because too many before were forged.",
        ),
        _table(
            "Present on thin links",
            "peer|#share of the time|#times lost|#longest gap s",
            (_online_row(peer, times, recording.end_s) for peer, times in sorted(recording.thin_present.items())),
            "Of the time since the peer was first heard there.",
        ),
        _table(
            "Radio paths",
            "peer|last radio|last next hop|#changes|#mean margin dB|#least margin dB|#least bottleneck Mbit/s"
            "|#worsening",
            (_radio_row(peer, use) for peer, use in sorted(recording.radio_paths.items())),
            "Measured by the robot's own radio. Changes: of next hop or radio. Worsening: share of the samples.",
        ),
        _table(
            "Intervals between messages",
            "source|topic|#intervals|#median s|#deviation s|#gaps|#within 5 %",
            (
                (
                    *(each.source, each.topic, str(each.values_s.count), f"{each.median_s:.3f}"),
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
        _table(
            "Events",
            "node|event|#times",
            ((at, kind, str(count)) for (at, kind), count in sorted(recording.event_counts.items())),
        ),
    ]


def _online_row(peer: str, times: OnlineTimes, end_s: float) -> tuple[str, ...]:
    longest = f"{times.longest_gap_s:.1f}" if times.times_lost else MISSING
    return peer, f"{figures.online_share(times, end_s):.1%}", str(times.times_lost), longest


def _thin_row(link: str, use: ThinLinkUse) -> tuple[str, ...]:
    totals, passed_s = use.totals, use.last.t - use.first.t
    share = f"{totals.airtime_s / passed_s:.2%}" if passed_s > 0 else MISSING
    return (
        *(link, f"{use.up_share:.1%}", f"{totals.airtime_s:.1f}", share),
        *(str(totals.frames_sent), f"{totals.bytes_sent / 1e3:.1f}", str(totals.frames_received)),
        *(str(totals.frames_forged + totals.frames_rejected), str(totals.parts_repeated)),
        *(str(totals.messages_given_up), str(totals.messages_dropped), str(use.most_queued)),
    )


def _radio_row(peer: str, use: RadioPathUse) -> tuple[str, ...]:
    radio, next_hop = (MISSING, MISSING) if use.last is None else (use.last.radio, use.last.next_hop)
    least = use.least_bottleneck_bits_per_s
    return (
        *(peer, radio, next_hop, str(use.changes), _decibels(use.mean_margin_db), _decibels(use.least_margin_db)),
        *(MISSING if least is None else f"{least / 1e6:.1f}", f"{use.worsening_share:.1%}"),
    )


def _decibels(value: float | None) -> str:
    return MISSING if value is None else f"{value:.1f}"


def _milliseconds(seconds: float | None) -> str:
    return MISSING if seconds is None else f"{seconds * 1e3:.1f}"


def _charts(recording: Recording, bins: Bins) -> list[dict[str, Any]]:
    started_s = recording.started

    def chart(title: str, unit: str, kind: str, series: list[dict[str, Any]], note: str) -> dict[str, Any]:
        times_s = bins.times_s(started_s) if series else []
        return {"title": title, "unit": unit, "kind": kind, "note": note, "times_s": times_s, "series": series}

    def lines(title: str, unit: str, gathered: BinnedLines) -> dict[str, Any]:
        labels, count = gathered.labels(MAX_LINES)
        note = f"Mean of each {bins.width_s:.3g} s; shaded from the least to the greatest value in it."
        if count > len(labels):
            note += f" The {len(labels)} of {count} with the greatest values."
        if gathered.left_out:
            note += f" At least {len(gathered.left_out)} more were not compared."
        return chart(title, unit, "lines", gathered.series(bins, labels), note)

    note = f"Received, mean of each {bins.width_s:.3g} s."
    if recording.received_bytes.left_out:
        note += f" At least {len(recording.received_bytes.left_out)} more topics are not in it."
    by_topic: dict[str, list[float]] = {}
    by_priority: dict[str, list[float]] = {}
    for topic, each in figures.received_topics(recording):
        sizes = recording.received_bytes.totals(bins, topic)
        by_topic[topic] = [8 * size / bins.width_s for size in sizes]
        total = by_priority.setdefault(f"priority {each.priority}", [0.0] * bins.count)
        for place, value in enumerate(by_topic[topic]):
            total[place] += value
    return [
        chart("Throughput by topic", "Mbit/s", "stacked", _layers(by_topic), note),
        chart("Throughput by priority", "Mbit/s", "stacked", _layers(by_priority), note),
        lines("Latency to the acknowledgment", "ms", recording.latencies_ms),
        *(lines(title, unit, recording.sampled[name]) for name, title, unit in _SAMPLED),
        *(lines(title, unit, recording.radio_sampled[name]) for name, title, unit in _RADIO_SAMPLED),
        lines("Airtime used on thin links", "%", recording.thin_airtime),
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
        "note": f"{each.values_s.count} intervals, median {each.median_s:.3f} s, {each.punctual:.1%} of them within 5 "
        f"% of it; standard deviation {each.deviation_s:.4f} s within 0.5 to 1.5 times the median; outside: "
        f"{each.gaps}. The curve is a normal distribution with a deviation of {PAPER_DEVIATION_S:.0%} of the median.",
    }


def _spans(recording: Recording, bins: Bins) -> dict[str, Any]:
    rows = []
    note = ""
    for peer, times in sorted(recording.online.items()):
        if len(times.spans_s) > MAX_SPANS or times.closed_gap_s:
            times.close_gaps(bins.width_s)
            note = (
                f"Of peers that came and went more than {MAX_SPANS} times, gaps below {bins.width_s:.3g} s are closed."
            )
        spans_s = [[round(recording.started + t, 3) for t in span] for span in times.spans_s]
        rows.append({"label": peer, "spans_s": spans_s})
    return {"title": "Online", "note": note, "rows": rows[:MAX_ROWS]}


def _events(recording: Recording) -> list[dict[str, Any]]:
    """All of the rarest kinds, others evenly thinned."""
    chosen: list[RecordedEvent] = []
    rarest_first = sorted(recording.events.values(), key=lambda kept: kept.count)
    for number, kept in enumerate(rarest_first):
        chosen += kept.items((MAX_EVENTS - len(chosen)) // (len(rarest_first) - number))
    return [
        {"time_s": round(recording.started + event.t, 3), "at": event.at, "kind": event.kind, "text": event.text}
        for event in sorted(chosen, key=lambda event: event.t)
    ]


def _tracks(recording: Recording) -> list[dict[str, Any]]:
    return [
        {"name": name, "points": [[round(recording.started + t, 3), *rest] for t, *rest in track.items()]}
        for name, track in sorted(recording.tracks.items())[:MAX_ROWS]
        if track.count > 1
    ]
