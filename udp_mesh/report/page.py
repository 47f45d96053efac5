"""One self-contained HTML page from recordings: totals, throughput by topic, connectivity, links, intervals."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from html import escape
from pathlib import Path

from udp_mesh.report import charts, figures
from udp_mesh.report.recording import Recording, Sample

_STYLE = """
body{font:15px/1.45 system-ui,sans-serif;max-width:800px;margin:2em auto;padding:0 1em;color:#222}
svg{width:100%;background:#fff}svg text{font:11px system-ui,sans-serif;fill:#444}.grid{stroke:#e4e4e4}
table{border-collapse:collapse}td,th{padding:.2em .8em;border-bottom:1px solid #ddd;text-align:right}
td:first-child,th:first-child{text-align:left}.legend span{margin-right:1.2em}
.legend i{display:inline-block;width:.9em;height:.9em;margin-right:.4em}
"""
# The paper's own distribution, for comparison (section "Performance").
PAPER_DEVIATION_S = 0.04
_SHOWN_INTERVALS = 4
_SHOWN_SPREAD = 0.25
"""Range shown on either side of the median, as a share of it: six of the paper's deviations."""


def page(recordings: Sequence[Recording], title: str) -> str:
    """The whole page, with one section per recording."""
    body = "".join(_section(recording, len(recordings) > 1) for recording in recordings)
    return (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{escape(title)}</title>'
        f"<style>{_STYLE}</style><h1>{escape(title)}</h1>{body}</html>\n"
    )


def write_page(recordings: Sequence[Recording], path: Path, title: str) -> None:
    """Writes the page atomically. Raises OSError."""
    text = page(recordings, title)
    try:
        # A temporary directory is removed with its contents, even after a write to a full disk failed.
        with tempfile.TemporaryDirectory(dir=path.parent, prefix=".report-") as directory:
            unfinished = Path(directory) / "page"
            unfinished.write_text(text, "utf-8")
            unfinished.replace(path)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error


def _section(recording: Recording, named: bool) -> str:
    parts = [f"<h2>As seen by {escape(recording.name)}</h2>"] if named else []
    if recording.problems:
        parts.append(f"<p>{len(recording.problems)} lines are invalid and were ignored.</p>")
    if recording.missing_lines:
        parts.append(
            f"<p>The disk did not keep up with the recording: {recording.missing_lines} lines are missing and not "
            "counted.</p>"
        )
    parts += [_totals(recording), _sent_topics(recording)]
    parts += [_differences(recording), _logs(recording), _throughput(recording), _connectivity(recording)]
    parts += [_links(recording), _map(recording)]
    parts += [_intervals(each) for each in figures.intervals(recording)[:_SHOWN_INTERVALS]]
    return "".join(parts)


def _totals(recording: Recording) -> str:
    _, topics = figures.throughput(recording)
    if not topics:
        return f"<p>{recording.end_s:.0f} s, nothing received.</p>"
    rows = "".join(
        f"<tr><td>{escape(each.topic)}</td><td>{each.priority}</td><td>{each.messages}</td>"
        f"<td>{each.total_bytes / 1e6:.2f}</td></tr>"
        for each in topics
    )
    total = sum(each.total_bytes for each in topics)
    return (
        f"<p>{recording.end_s:.0f} s, {len(recording.arrivals)} messages, {total / 1e6:.1f} MB received.</p>"
        f"<table><tr><th>topic</th><th>priority</th><th>messages</th><th>MB</th></tr>{rows}</table>"
    )


def _sent_topics(recording: Recording) -> str:
    sent = figures.sent_topics(recording)
    if not sent:
        return ""
    rows = "".join(
        f"<tr><td>{escape(each.topic)}</td><td>{each.messages}</td><td>{each.total_bytes / 1e6:.2f}</td>"
        f"<td>{each.delivered}</td><td>{each.expired}</td><td>{each.peer_lost}</td>"
        f"<td>{_milliseconds(each.latency_s(0.5))}</td><td>{_milliseconds(each.latency_s(0.99))}</td></tr>"
        for each in sent
    )
    return (
        "<h3>Messages sent by this node</h3><table><tr><th>topic</th><th>messages</th><th>MB</th>"
        "<th>delivered</th><th>expired</th><th>peer lost</th><th>p50 ms</th><th>p99 ms</th></tr>"
        f"{rows}</table><p>Outcomes count destinations; a single-datagram broadcast has none. Latency is measured from "
        "sending to the acknowledgment.</p>"
    )


def _differences(recording: Recording) -> str:
    sent = figures.differences(recording)
    if not sent:
        return ""
    rows = "".join(
        f"<tr><td>{escape(topic)}</td><td>{totals.whole}</td><td>{totals.differences}</td>"
        f"<td>{totals.payload_bytes / 1e6:.2f}</td><td>{totals.body_bytes / 1e6:.2f}</td>"
        f"<td>{_saved(totals.payload_bytes, totals.body_bytes)}</td></tr>"
        for topic, totals in sent
    )
    return (
        "<h3>Differences sent by this node</h3><table><tr><th>topic</th><th>whole</th><th>differences</th>"
        f"<th>MB</th><th>MB on the wire</th><th>saved</th></tr>{rows}</table>"
        "<p>On the wire: without headers and retransmissions, once for each destination.</p>"
    )


def _saved(payload_bytes: int, body_bytes: int) -> str:
    return "-" if payload_bytes <= 0 else f"{1 - body_bytes / payload_bytes:.0%}"


def _logs(recording: Recording) -> str:
    if not recording.logs:
        return ""
    rows = "".join(
        f"<tr><td>{escape(topic)}</td><td>{escape(source)}</td><td>{log.received_items} of {log.known_items}</td>"
        f"<td>{log.held_bytes / 1e6:.2f}</td></tr>"
        for (topic, source), log in sorted(recording.logs.items())
    )
    return (
        "<h3>Shared logs at the end</h3><table><tr><th>log</th><th>source</th><th>items received</th>"
        f"<th>MB on disk</th></tr>{rows}</table>"
    )


def _milliseconds(seconds: float | None) -> str:
    return "-" if seconds is None else f"{seconds * 1e3:.1f}"


def _throughput(recording: Recording) -> str:
    _, topics = figures.throughput(recording)
    if not topics:
        return ""
    layers = {each.topic: [value / 1e6 for value in each.bits_per_s] for each in topics}
    chart = charts.stacked(layers, recording.end_s, "seconds", "Mbit/s")
    return f"<h3>Throughput by topic</h3>{charts.legend(list(layers))}{chart}"


def _connectivity(recording: Recording) -> str:
    peers = figures.connections(recording)
    if not peers:
        return ""
    rows = {each.peer: each.spans_s for each in peers}
    shares = ", ".join(f"{escape(each.peer)} {each.share:.0%}" for each in peers)
    return (
        f"<h3>Online</h3>{charts.spans(rows, recording.end_s, 'seconds')}<p>Share of the time since first seen: "
        f"{shares}.</p>"
    )


def _links(recording: Recording) -> str:
    """Round-trip time and loss of each peer over the run."""
    readings: tuple[tuple[str, str, Callable[[Sample], float | None]], ...] = (
        ("Round-trip time", "ms", lambda sample: None if sample.round_trip_s is None else sample.round_trip_s * 1e3),
        ("Loss to the peer", "%", lambda sample: None if sample.loss is None else sample.loss * 100),
    )
    parts = []
    for heading, unit, read in readings:
        series = figures.time_series(recording, read)
        if series:
            chart = charts.over_time(series, recording.end_s, "seconds", unit)
            parts.append(f"<h3>{heading}</h3>{charts.legend(list(series))}{chart}")
    return "".join(parts)


def _map(recording: Recording) -> str:
    """Each peer's positions, and whether it was online there."""
    online = {each.peer: each.spans_s for each in figures.connections(recording)}
    tracks: dict[str, list[tuple[float, float, bool]]] = {}
    marks: dict[str, tuple[float, float]] = {}
    for place in recording.places:
        if place.at in online:
            connected = any(start <= place.t <= stop for start, stop in online[place.at])
            tracks.setdefault(place.at, []).append((place.x, place.y, connected))
        else:
            marks[place.at] = (place.x, place.y)
    if not tracks:
        return ""
    return f"<h3>Where the robots were online</h3>{charts.legend(list(tracks))}{charts.paths(tracks, marks)}"


def _intervals(each: figures.Intervals) -> str:
    low, high = (1 - _SHOWN_SPREAD) * each.median_s, (1 + _SHOWN_SPREAD) * each.median_s
    bars = figures.histogram(each.values_s, low, high)
    chart = charts.density(bars, low, high, (each.median_s, PAPER_DEVIATION_S * each.median_s), "seconds")
    return (
        f"<h3>Interval between messages: {escape(each.topic)} from {escape(each.source)}</h3>{chart}"
        f"<p>{len(each.values_s)} intervals, median {each.median_s:.3f} s, {each.punctual:.1%} of them within 5 % of "
        f"it; standard deviation {each.deviation_s:.4f} s within 0.5 to 1.5 times the median, {each.gaps} gaps "
        f"outside. The curve is a normal distribution with a deviation of {PAPER_DEVIATION_S:.0%} of the median.</p>"
    )
