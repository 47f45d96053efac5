"""What a collector measured of the radio, in a recording: samples, how each path was, charts, and what is invalid."""

from __future__ import annotations

import json
from typing import Any

import pytest

from udp_mesh.report.aggregate import parse
from udp_mesh.report.document import document_of
from udp_mesh.report.figures import summary
from udp_mesh.report.recording import header

PATH: dict[str, Any] = {
    "source": "husky-radio",
    "radio": "husky-radio",
    "next_hop": "b02",
    "signal_dbm": -60.0,
    "noise_dbm": -95.0,
    "margin_db": 10.0,
    "bottleneck_bits_per_s": 20e6,
    "quality": None,
    "trend": {"direction": "worsening", "change_db_per_s": -0.5},
    "age_s": 0.5,
}


def conditions(t: float, path: object, *, online: bool = True, radio: object = None) -> bytes:
    peer = {"name": "base", "online": online, "radio": path}
    return json.dumps({"t": t, "kind": "conditions", "peers": [peer], "radio": radio}).encode()


def test_a_radio_path_is_shown_with_its_margin_next_hops_and_bottleneck() -> None:
    steady = {"direction": "steady", "change_db_per_s": 0.0}
    recording = parse(
        [
            header("husky", 0.0).encode(),
            conditions(0.0, PATH),
            conditions(1.0, {**PATH, "margin_db": -2.0, "bottleneck_bits_per_s": 1e6}),
            conditions(2.0, None),
            # the radio hears the way to a base whose daemon is gone
            conditions(3.0, {**PATH, "next_hop": "b03", "trend": steady}, online=False),
            conditions(
                4.0, {**PATH, "next_hop": "b03", "margin_db": None, "trend": None, "bottleneck_bits_per_s": None}
            ),
        ],
        "r.jsonl",
    )
    assert recording.problems == []
    assert summary(recording)["radio_paths"] == [
        {
            "peer": "base",
            "samples": 4,
            "changes": 1,
            "mean_margin_db": 6.0,
            "least_margin_db": -2.0,
            "least_bottleneck_bits_per_s": 1e6,
            "worsening": 0.5,
        }
    ]
    document = document_of(recording)
    (table,) = (table for table in document["tables"] if table["title"] == "Radio paths")
    assert table["rows"] == [["base", "husky-radio", "b03", "1", "6.0", "-2.0", "1.0", "50.0%"]]
    (chart,) = (chart for chart in document["charts"] if chart["title"] == "Radio margin of the next hop to the peer")
    (line,) = chart["series"]
    assert (line["label"], chart["unit"]) == ("base", "dB")
    assert [value for value in line["values"] if value is not None] == [10.0, -2.0, 10.0]
    titles = {chart["title"]: chart["unit"] for chart in document["charts"]}
    assert titles["Bottleneck of the radio path to the peer"] == "Mbit/s"


def test_a_radio_that_gives_no_new_values_is_an_event_when_it_begins_and_ends() -> None:
    down = {"source": "husky-radio", "problem": "husky-radio does not answer", "age_s": 0.1, "neighbors": []}
    radios = [None, {**down, "problem": None}, down, down, None, down]
    lines = [conditions(float(t), None, radio=radio) for t, radio in enumerate(radios)]
    recording = parse([header("husky", 0.0).encode(), *lines], "r.jsonl")
    events = [(event["kind"], event["time_s"], event["text"]) for event in document_of(recording)["events"]]
    assert [event for event in events if event[0] == "radio-problem"] == [
        ("radio-problem", 2.0, "husky-radio does not answer"),
        ("radio-problem", 4.0, "no problem any more"),
        ("radio-problem", 5.0, "husky-radio does not answer"),
    ]


def test_without_a_collector_there_is_no_table() -> None:
    recording = parse([header("husky", 0.0).encode(), conditions(0.0, None)], "r.jsonl")
    assert "Radio paths" not in [table["title"] for table in document_of(recording)["tables"]]


@pytest.mark.parametrize(
    ("path", "radio", "problem"),
    [
        (5, None, "expected an object as radio, found 5"),
        ({**PATH, "next_hop": None}, None, "expected a string as next_hop, found None"),
        ({**PATH, "margin_db": "high"}, None, "expected a number from -1000 to 1000 as margin_db, found high"),
        ({**PATH, "bottleneck_bits_per_s": -1}, None, "expected a number from 0 to 1e+12 as bottleneck_bits_per_s"),
        (PATH, [], "expected an object as radio, found []"),
        (PATH, {"problem": 5}, "expected a string as problem, found 5"),
    ],
)
def test_invalid_values_are_reported_with_their_line(path: object, radio: object, problem: str) -> None:
    recording = parse([header("husky", 0.0).encode(), conditions(0.0, path, radio=radio)], "r.jsonl")
    (found,) = recording.problems
    assert found.startswith(f"r.jsonl:2: {problem}")
