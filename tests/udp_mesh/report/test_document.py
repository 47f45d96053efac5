"""The document of a recording: bounded, with the peaks of what it summarizes and every bit counted."""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterable
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from udp_mesh.report import aggregate
from udp_mesh.report.aggregate import BINS, MAX_EVENTS, MAX_POINTS, MAX_SPANS, Recording, parse
from udp_mesh.report.bins import MAX_LABELS, BinnedLines, Bins, Thinned, thinned
from udp_mesh.report.distribution import MAX_EXACT, Distribution
from udp_mesh.report.document import MAX_LAYERS, MAX_LINES, document_of

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
def test_bins_keep_the_least_the_greatest_and_the_sum(end_s: float, points: list[tuple[float, float]]) -> None:
    bins = Bins.at_most(10, end_s)
    assert bins.count <= 10
    assert bins.width_s * bins.count >= end_s * (1 - 1e-6)
    lines = BinnedLines(10)
    for share, value in points:
        lines.add("one", share * end_s, value)
    (line,) = lines.series(bins, ["one"])
    shown = [value for value in (*line["values"], *line.get("high", ()), *line.get("low", ())) if value is not None]
    assert max(shown) == pytest.approx(max(value for _, value in points), rel=1e-3, abs=1e-30)
    assert min(shown) == pytest.approx(min(value for _, value in points), rel=1e-3, abs=1e-30)
    assert sum(lines.totals(bins, "one")) == pytest.approx(sum(value for _, value in points), rel=1e-9, abs=1e-3)


def test_a_point_is_in_the_bin_of_its_time_whatever_came_after_it() -> None:
    lines = BinnedLines(240)
    for t in range(36_000):
        lines.add("one", float(t), float(t))
    bins = Bins.at_most(240, 36_000.0)
    (line,) = lines.series(bins, ["one"])
    assert bins.width_s == 200
    assert (line["low"][:2], line["high"][:2]) == ([0.0, 200.0], [199.0, 399.0])
    assert lines.totals(bins, "one")[0] == sum(range(200))


@given(st.lists(st.floats(0, 1e6), min_size=1), st.floats(0, 0.999))
def test_quantiles_are_exact_for_few_values_and_close_for_many(values: list[float], share: float) -> None:
    exact = sorted(values)[int(share * len(values))]
    assert Distribution.of(values).quantile(share) == exact
    many = Distribution.of(value for value in values for _ in range(1 + MAX_EXACT // len(values)))
    found = many.quantile(share)
    assert many.count > MAX_EXACT
    assert found == pytest.approx(exact, rel=2e-3, abs=1e-6)


def test_thinning_keeps_both_ends() -> None:
    assert thinned(range(1000), 4) == [0, 333, 666, 999]
    assert thinned([1, 2], 4) == [1, 2]


@given(st.integers(1, 3000), st.integers(2, 50))
def test_items_are_thinned_while_they_arrive(count: int, limit: int) -> None:
    kept = Thinned[int](limit)
    for number in range(count):
        kept.add(number)
    shown = kept.items()
    assert (shown[0], shown[-1], kept.count) == (0, count - 1, count)
    assert len(shown) == min(count, len(shown), limit)
    assert len(shown) >= min(count, limit)
    steps = [later - earlier for earlier, later in itertools.pairwise(shown)]
    assert max(steps, default=0) <= max(1, 3 * count / limit)


def test_a_rare_event_is_listed_among_thousands_of_frequent_ones() -> None:
    def entries() -> Iterable[dict[str, Any]]:
        for i in range(5000):
            yield {"t": i * 2.0, "kind": "peer-online", "peer": "flapping"}
            yield {"t": i * 2.0 + 1, "kind": "peer-offline", "peer": "flapping"}
            if i == 3210:
                yield {"t": i * 2.0 + 1, "kind": "peer-restarted", "peer": "spot1"}

    found = document(entries())
    assert [event["text"] for event in found["events"] if event["kind"] == "peer-restarted"] == ["peer spot1"]
    assert len(found["events"]) <= MAX_EVENTS
    assert "1000 of 10001 events" in " ".join(found["notes"])
    times = [event["time_s"] for event in found["events"]]
    assert times == sorted(times)


def size_of(value: object) -> int:
    """Numbers and texts in it, at any depth."""
    if isinstance(value, dict):
        return sum(size_of(key) + size_of(one) for key, one in value.items())
    if isinstance(value, str | int | float | bool | None):
        return 1
    if isinstance(value, BinnedLines):
        return size_of(value._lines) + len(value.left_out)
    if hasattr(value, "__len__") and hasattr(value, "__iter__"):
        return sum(map(size_of, value))
    names = getattr(type(value), "__slots__", None) or getattr(value, "__dict__", {})
    return sum(size_of(getattr(value, name)) for name in names if name != "__weakref__")


def test_the_memory_of_a_recording_does_not_grow_with_its_length() -> None:
    def entries(seconds: int) -> Iterable[bytes]:
        yield b'{"recording": 1, "node": "base", "started": 0}'
        for t in range(seconds):
            for entry in (
                conditions(float(t), spot1={"round_trip_s": 0.001 * (t % 50), "loss": 0.1, "outbox_messages": t}),
                {"t": t, "kind": "received", "source": "s", "topic": "map", "priority": 1, "bytes": t},
                {"t": t, "kind": "place", "at": "spot1", "x": t, "y": 0.0},
                {"t": t, "kind": ("peer-online", "peer-offline")[t % 2], "peer": "spot2"},
                {"t": t, "kind": "message-delivered", "peer": "a", "topic": "b", "latency_s": 0.01 * (t % 97)},
            ):
                yield json.dumps(entry).encode()

    short, long = (size_of(parse(entries(seconds), "r")) for seconds in (12_000, 48_000))
    # sawtooth: kept items are at most twice the limit
    assert long < 2 * short


def test_names_beyond_the_limit_are_counted_and_not_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(aggregate, "MAX_NAMES", 300)
    found: Recording = parse(
        [
            b'{"recording": 1, "node": "base", "started": 0}',
            *(
                json.dumps(
                    {"t": 1, "kind": "received", "source": f"s{i}", "topic": f"t{i}", "priority": 1, "bytes": 1}
                ).encode()
                for i in range(400)
            ),
            *(json.dumps(conditions(2.0, **{f"p{i}": {"loss": 0.1} for i in range(400)})).encode() for _ in range(2)),
            *(json.dumps({"t": 3, "kind": f"kind{i}"}).encode() for i in range(400)),
        ],
        "r",
    )
    assert len(found.received) == len(found.arrivals) == len(found.event_counts) == 300
    assert len(found.events) == aggregate.MAX_EVENT_KINDS + 1
    assert len(found.online) == 300
    # topics twice (the throughput's are fewer), events once, peers of both lines
    assert found.unnamed == 100 + 100 + 100
    shown = document_of(found)
    assert "300 values of further ones are not counted" in " ".join(shown["notes"])
    assert f"At least {400 - MAX_LABELS} more were not compared" in chart(shown, "Loss to the peer")["note"]
    assert len(json.dumps(shown)) < 500_000
