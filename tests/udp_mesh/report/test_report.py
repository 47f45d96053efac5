"""A recording survives being written and read, torn and foreign lines included; the page shows what it holds."""

from __future__ import annotations

import json
from pathlib import Path
from xml.etree import ElementTree

import pytest
from hypothesis import given
from hypothesis import strategies as st

from udp_mesh.report import main
from udp_mesh.report.charts import density, paths, spans, stacked, ticks
from udp_mesh.report.figures import connections, histogram, intervals, throughput
from udp_mesh.report.page import page
from udp_mesh.report.recording import (
    Arrival,
    Place,
    Presence,
    Recording,
    RecordingError,
    Sample,
    header,
    line,
    parse,
    read,
)

ITEMS = (
    Presence(1.0, "base", "spot1", True),
    Arrival(1.5, "base", "spot1", "telemetry", 3, 1000),
    Sample(2.0, "base", "spot1", 0.02, 0.05, 8000.0, 2),
    Place(2.0, "spot1", 10.0, 20.5),
    Presence(3.0, "base", "spot1", False),
)


def lines(*items: Arrival | Presence | Sample | Place) -> list[bytes]:
    return [text.encode() for text in (header("base", 0.0), *map(line, items))]


def test_what_is_written_is_read() -> None:
    read_back = parse(lines(*ITEMS), "r.jsonl")
    assert (*read_back.arrivals, *read_back.presences, *read_back.samples, *read_back.places) == (
        ITEMS[1], ITEMS[0], ITEMS[4], ITEMS[2], ITEMS[3]
    )  # fmt: skip
    assert read_back.problems == []
    assert read_back.end_s == 3.0


def test_a_torn_line_is_left_out_and_told() -> None:
    recording = parse([*lines(*ITEMS), b'{"t": 4, "kind": "recei'], "r.jsonl")
    assert len(recording.arrivals) == 1
    assert recording.problems[0].startswith("r.jsonl:7:")


def test_what_is_no_recording_is_an_error_with_its_line(tmp_path: Path) -> None:
    path = tmp_path / "r.jsonl"
    path.write_text("{}\n")
    with pytest.raises(RecordingError, match=r"r\.jsonl:1: expected"):
        read(path)
    assert main([str(path), "--out", str(tmp_path / "r.html")]) == 2
    assert not (tmp_path / "r.html").exists()


@given(st.lists(st.binary(max_size=60)))
def test_any_lines_give_a_recording_or_a_recording_error(raw: list[bytes]) -> None:
    for start in ([], [header("x", 0.0).encode()]):
        try:
            page([parse([*start, *raw], "r")], "any")
        except RecordingError as error:
            assert str(error).startswith("r:1:")


@given(
    st.recursive(
        st.none() | st.booleans() | st.floats() | st.text(), lambda c: st.lists(c) | st.dictionaries(st.text(), c)
    )
)
def test_any_json_in_a_known_kind_is_an_item_or_a_problem(value: object) -> None:
    for kind in ("received", "peer-online", "conditions", "place"):
        entry = {"t": value, "kind": kind, "peer": value, "peers": value, "x": value, "y": 1, "source": value}
        parse([header("x", 0.0).encode(), json.dumps(entry).encode()], "r")


def periodic(jitter: float) -> Recording:
    items = [Arrival(i + (jitter if i % 2 else 0.0), "base", "spot1", "telemetry", 3, 100) for i in range(100)]
    return parse(lines(*items), "r")


def test_intervals_tell_median_deviation_and_gaps() -> None:
    (steady,) = intervals(periodic(0.0))
    assert (steady.median_s, steady.deviation_s, steady.gaps) == (1.0, 0.0, 0)
    (jittered,) = intervals(periodic(0.1))
    assert jittered.deviation_s == pytest.approx(0.1, abs=0.01)
    lonely = parse(lines(*[Arrival(t, "base", "s", "t", 1, 1) for t in [*range(30), *range(100, 130)]]), "r")
    assert intervals(lonely)[0].gaps == 1


def test_connections_are_spans_with_their_share() -> None:
    recording = parse(lines(*ITEMS, Presence(5.0, "base", "spot1", True), Place(9.0, "base", 0, 0)), "r")
    (spot,) = connections(recording)
    assert spot.spans_s == ((1.0, 3.0), (5.0, 9.0))
    assert spot.share == 6 / 8


def test_throughput_keeps_every_bit() -> None:
    width_s, (topic,) = throughput(periodic(0.0), bins=10)
    assert sum(topic.bits_per_s) * width_s == pytest.approx(100 * 100 * 8)


@given(st.lists(st.floats(0, 2), min_size=1))
def test_a_histogram_is_a_density(values: list[float]) -> None:
    inside = sum(0 <= value < 2 for value in values)
    assert sum(histogram(tuple(values), 0.0, 2.0, 8)) * 0.25 == pytest.approx(inside / len(values))


@given(st.floats(-1e6, 1e6), st.floats(1e-3, 1e6))
def test_ticks_are_few_and_inside(low: float, span: float) -> None:
    found = ticks(low, low + span)
    assert 1 <= len(found) <= 11
    assert all(low - 1e-6 * span <= value <= low + span * (1 + 1e-6) for value in found)


def test_pictures_are_well_formed_and_escape_names() -> None:
    for picture in (
        density([0.1, 2.0], 0.0, 1.0, (0.5, 0.1), "s"),
        spans({"<a>&": [(0.0, 1.0)]}, 2.0, "s"),
        stacked({"<b>": [1.0, 2.0], "c": [0.0, 1.0]}, 2.0, "s", "Mbit/s"),
        paths({"d": [(0, 0, True), (5, 5, False)]}, {"<e>": (1, 1)}),
    ):
        ElementTree.fromstring(picture)


def test_the_page_shows_every_topic_and_peer(tmp_path: Path) -> None:
    path = tmp_path / "base.jsonl"
    path.write_bytes(b"\n".join(lines(*ITEMS)) + b"\n")
    out = tmp_path / "page.html"
    assert main([str(path), "--out", str(out)]) == 0
    text = out.read_text()
    for expected in ("telemetry", "spot1", "Throughput by topic", "Online", "Where the robots were online"):
        assert expected in text
