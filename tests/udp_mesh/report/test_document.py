"""The document of a recording: bounded, with the peaks of what it summarizes and every bit counted."""

from __future__ import annotations

import json
from collections.abc import Iterable
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from udp_mesh.report.bins import BinnedLines, Bins, thinned
from udp_mesh.report.document import BINS, MAX_EVENTS, MAX_LAYERS, MAX_LINES, MAX_POINTS, MAX_SPANS, document_of
from udp_mesh.report.recording import parse

HOURS_S = 4 * 3600.0


def document(entries: Iterable[dict[str, Any]], node: str = "base") -> dict[str, Any]:
    head = {"recording": 1, "node": node, "started": 1000.0}
    return document_of(parse((json.dumps(one).encode() for one in (head, *entries)), "r"))


def chart(found: dict[str, Any], title: str) -> dict[str, Any]:
    (one,) = (each for each in found["charts"] if each["title"] == title)
    return dict(one)


def values(found: dict[str, Any], title: str) -> dict[str, list[float | None]]:
    return {one["label"]: one["values"] for one in chart(found, title)["series"]}


def conditions(t: float, **peers: dict[str, Any]) -> dict[str, Any]:
    return {
        "t": t,
        "kind": "conditions",
        "peers": [{"name": name, "online": True, **one} for name, one in peers.items()],
    }


def test_a_short_peak_in_hours_stays_visible() -> None:
    found = document(
        conditions(float(t), spot1={"round_trip_s": 2.0 if t == 7000 else 0.02}) for t in range(int(HOURS_S))
    )
    (line,) = chart(found, "Round-trip time")["series"]
    assert max(line["high"]) == 2000.0
    assert max(line["values"]) < 100
    assert len(line["values"]) <= BINS
    assert "Mean of each 100 s" in chart(found, "Round-trip time")["note"]


def test_throughput_counts_every_bit_by_topic_and_by_priority() -> None:
    found = document(
        {"t": float(t), "kind": "received", "source": "s", "topic": f"t{t % 12}", "priority": t % 3, "bytes": 125_000}
        for t in range(480)
    )
    for title in ("Throughput by topic", "Throughput by priority"):
        width_s = chart(found, title)["times_s"][1] - chart(found, title)["times_s"][0]
        total = sum(value or 0.0 for each in values(found, title).values() for value in each)
        assert total * width_s == pytest.approx(480, rel=1e-3)
    assert len(values(found, "Throughput by topic")) == MAX_LAYERS + 1
    assert "4 others" in values(found, "Throughput by topic")
    # the most urgent is the lowest layer, which is drawn last
    assert list(values(found, "Throughput by priority")) == ["priority 2", "priority 1", "priority 0"]


def test_charts_have_what_is_known_and_gaps_where_nothing_is() -> None:
    found = document(
        [
            conditions(0.0, spot1={"outbox_messages": 3, "loss": 0.25, "hops": 2}),
            {"t": 4.0, "kind": "message-delivered", "peer": "spot1", "topic": "estop", "latency_s": 0.03},
            conditions(9.0, spot1={"outbox_messages": 5}),
        ]
    )
    assert [one["title"] for one in found["charts"]] == [
        "Latency to the acknowledgment",
        "Loss to the peer",
        "Outbox for the peer",
        "Hops to the peer",
    ]
    outbox = values(found, "Outbox for the peer")["spot1"]
    assert (outbox[0], outbox[-1], set(outbox[1:-1])) == (3.0, 5.0, {None})


def test_events_are_listed_with_their_time_and_counted() -> None:
    entries = [
        {"t": 1.0, "kind": "peer-online", "peer": "spot1"},
        {"t": 2.0, "kind": "topic-starved", "peer": "spot1", "topic": "map", "more": {"nested": 1}},
        {"t": 3.0, "kind": "peer-offline", "peer": "spot1", "at": "husky1"},
    ]
    found = document(entries)
    assert found["events"][1] == {
        "time_s": 1002.0, "at": "base", "kind": "topic-starved", "text": "peer spot1, topic map"
    }  # fmt: skip
    (table,) = (one for one in found["tables"] if one["title"] == "Events")
    assert ["husky1", "peer-offline", "1"] in table["rows"]


def test_everything_is_bounded() -> None:
    def entries() -> Iterable[dict[str, Any]]:
        for i in range(6000):
            yield {"t": i * 2.0, "kind": "peer-online", "peer": "flapping"}
            yield {"t": i * 2.0 + 1, "kind": "peer-offline", "peer": "flapping"}
            yield {"t": i * 2.0 + 1, "kind": "place", "at": "flapping", "x": i, "y": 0.0}
        yield conditions(12_000.0, **{f"p{i}": {"loss": i / 100} for i in range(50)})

    found = document(entries())
    assert len(found["events"]) == MAX_EVENTS
    (spans,) = (row["spans_s"] for row in found["spans"]["rows"] if row["label"] == "flapping")
    assert len(spans) <= MAX_SPANS
    assert "gaps below 50 s are closed" in found["spans"]["note"]
    (track,) = found["tracks"]
    assert len(track["points"]) == MAX_POINTS
    loss = values(found, "Loss to the peer")
    assert len(loss) == MAX_LINES
    assert "p49" in loss
    assert "The 12 of 50" in chart(found, "Loss to the peer")["note"]
    assert len(json.dumps(found)) < 1_000_000


def test_a_track_says_where_a_robot_was_online() -> None:
    entries: list[dict[str, Any]] = [
        {"t": 0.0, "kind": "place", "at": "spot1", "x": 0.0, "y": 0.0},
        {"t": 1.0, "kind": "peer-online", "peer": "spot1"},
        *({"t": t, "kind": "place", "at": "spot1", "x": t, "y": 1.0} for t in (2.0, 3.0, 3.5)),
        {"t": 4.0, "kind": "peer-offline", "peer": "spot1"},
        {"t": 5.0, "kind": "place", "at": "spot1", "x": 5.0, "y": 1.0},
    ]
    (track,) = document(entries)["tracks"]
    assert [point[3] for point in track["points"]] == [False, True, True, True, False]
    assert track["points"][1] == [1002.0, 2.0, 1.0, True]


@given(st.floats(0, 1e6), st.lists(st.tuples(st.floats(0, 1), st.floats(-1e6, 1e6)), min_size=1))
def test_bins_keep_the_least_and_the_greatest_value(end_s: float, points: list[tuple[float, float]]) -> None:
    bins = Bins.at_most(10, end_s)
    assert bins.count <= 10
    assert bins.width_s * bins.count >= end_s * (1 - 1e-6)
    lines = BinnedLines(bins)
    for share, value in points:
        lines.add("one", share * end_s, value)
    (line,) = lines.series()
    shown = [value for value in (*line["values"], *line.get("high", ()), *line.get("low", ())) if value is not None]
    assert max(shown) == pytest.approx(max(value for _, value in points), rel=1e-3)
    assert min(shown) == pytest.approx(min(value for _, value in points), rel=1e-3)


def test_thinning_keeps_both_ends() -> None:
    assert thinned(range(1000), 4) == [0, 333, 666, 999]
    assert thinned([1, 2], 4) == [1, 2]
