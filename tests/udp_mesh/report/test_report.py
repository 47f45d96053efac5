"""A recording survives a round trip, with truncated and foreign lines; figures and commands show its contents."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from udp_mesh.report import main
from udp_mesh.report import recording as report_recording
from udp_mesh.report.aggregate import Recording, parse, read
from udp_mesh.report.distribution import Distribution
from udp_mesh.report.document import document_of
from udp_mesh.report.figures import histogram, intervals, online_share, sent_topics, summary
from udp_mesh.report.recording import (
    Item,
    Place,
    Presence,
    RecordedArrival,
    RecordedEvent,
    RecordingError,
    RecordingReader,
    Sample,
    Snapshot,
    header,
    line,
)
from udp_mesh.report.text import text_of

ITEMS = (
    Presence(1.0, "base", "spot1", True),
    RecordedArrival(1.5, "base", "spot1", "telemetry", 3, 1000),
    Sample(2.0, "base", "spot1", 0.02, 0.05, 8000.0, 2),
    Place(2.0, "spot1", 10.0, 20.5),
    Presence(3.0, "base", "spot1", False),
)


def lines(*items: RecordedArrival | Presence | Sample | Place) -> list[bytes]:
    return [text.encode() for text in (header("base", 0.0), *map(line, items))]


def test_recordings_round_trip() -> None:
    reader = RecordingReader(lines(*ITEMS), "r.jsonl")
    # an event beside each presence, and the conditions that a sample belongs to
    assert [item for item in reader if not isinstance(item, RecordedEvent | Snapshot)] == list[Item](ITEMS)
    assert (reader.name, reader.started, parse(lines(*ITEMS), "r.jsonl").end_s) == ("base", 0.0, 3.0)


def test_a_truncated_line_is_ignored_and_reported() -> None:
    recording = parse([*lines(*ITEMS), b'{"t": 4, "kind": "recei'], "r.jsonl")
    assert recording.messages == 1
    assert recording.problems[0].startswith("r.jsonl:7:")


@pytest.mark.parametrize(
    ("raw", "problem"),
    [
        ('{"t": 4, "kind": "recei', "expected one JSON object, found invalid JSON (a truncated line?)"),
        ("[1]", "expected one JSON object, found another JSON value"),
        ('{"kind": "place"}', "expected a number from 0 to 1e+09 as t, found None"),
        ('{"t": NaN, "kind": "place"}', "expected a number from 0 to 1e+09 as t, found nan"),
        ('{"t": 1e308, "kind": "place"}', "expected a number from 0 to 1e+09 as t, found 1e+308"),
        ('{"t": -3, "kind": "place"}', "expected a number from 0 to 1e+09 as t, found -3"),
        ('{"t": 1, "kind": "place", "x": 1e308, "y": 1}', "expected a number from -1e+07 to 1e+07 as x, found 1e+308"),
        ('{"t": 1, "kind": "peer-online", "peer": 5}', "expected a string as peer, found 5"),
        (
            '{"t": 1, "kind": "received", "source": "a", "topic": "t", "priority": 1, "bytes": 1e400}',
            "expected a number from 0 to 1.1259e+15 as bytes, found inf",
        ),
        (
            '{"t": 1, "kind": "conditions", "peers": [{"name": "a", "loss": -1}]}',
            "expected a number from 0 to 1e+15 as loss, found -1",
        ),
        ('{"t": 1, "kind": "conditions", "peers": 5}', "expected a list of objects as peers, found 5"),
    ],
)
def test_a_damaged_line_is_ignored_and_reported_with_the_reason(raw: str, problem: str) -> None:
    recording = parse([header("base", 0.0).encode(), raw.encode()], "r")
    assert recording.problems == [f"r:2: {problem}"]
    assert "Invalid lines, which were ignored: 1." in text_of(document_of(recording))


def test_a_recording_that_begins_while_peers_are_online_shows_them() -> None:
    def conditions(t: float, online: bool) -> bytes:
        peer = {"name": "spot1", "online": online, "loss": 0.5}
        return json.dumps({"t": t, "kind": "conditions", "peers": [peer]}).encode()

    offline = line(Presence(4.0, "base", "spot1", False)).encode()
    recording = parse(
        [header("base", 0.0).encode(), conditions(0.0, True), conditions(2.0, True), offline, conditions(5.0, False)],
        "r",
    )
    spot = recording.online["spot1"]
    assert (spot.spans_s, online_share(spot, recording.end_s)) == ([(0.0, 4.0)], 0.8)
    assert (spot.times_lost, spot.longest_gap_s) == (1, 1.0)
    # Values of an offline peer are old.
    (loss,) = (one for one in document_of(recording)["charts"] if one["title"] == "Loss to the peer")
    shown = [time_s for time_s, value in zip(loss["times_s"], loss["series"][0]["values"], strict=True) if value]
    assert [int(time_s) for time_s in shown] == [0, 2]


def test_outcomes_of_sent_messages_are_counted_per_topic() -> None:
    entries = [
        {"t": 1, "kind": "sent", "topic": "map", "priority": 7, "bytes": 500},
        {"t": 1, "kind": "sent", "topic": "estop", "priority": 0, "bytes": 4},
        {"t": 2, "kind": "message-delivered", "peer": "b", "topic": "estop", "latency_s": 0.02},
        {"t": 2, "kind": "message-delivered", "peer": "c", "topic": "estop", "latency_s": 0.04},
        {"t": 3, "kind": "message-expired", "peer": "b", "topic": "map", "reason": "deadline"},
        {"t": 3, "kind": "message-peer-lost", "peer": "c", "topic": "map"},
    ]
    recording = parse([header("a", 0.0).encode(), *(json.dumps(entry).encode() for entry in entries)], "r")
    (first, estop), (_, bulk) = sent_topics(recording)
    assert (first, estop.messages, estop.outcomes["delivered"], estop.latencies_s.quantile(0.5)) == (
        "estop", 1, 2, 0.04
    )  # fmt: skip
    assert (bulk.total_bytes, bulk.outcomes["expired"], bulk.outcomes["peer-lost"]) == (500, 1, 1)
    assert bulk.latencies_s.quantile(0.5) is None
    (table,) = (one for one in document_of(recording)["tables"] if one["title"] == "Sent")
    assert table["rows"][0] == ["estop", "1", "0.00", "2", "0", "0", "40.0", "40.0"]


def test_lines_that_were_never_written_are_reported() -> None:
    recording = parse([header("a", 0.0).encode(), b'{"t": 1, "kind": "gap", "lines": 40}'], "r")
    assert "40 lines are missing" in text_of(document_of(recording))
    assert summary(recording)["lines_left_out"] == 40


def test_a_message_recorded_with_a_large_payload_is_counted(tmp_path: Path) -> None:
    path = tmp_path / "r.jsonl"
    entry = {"t": 1, "kind": "received", "source": "a", "topic": "map", "priority": 7, "bytes": 3 << 19}
    path.write_text(header("a", 0.0) + "\n" + json.dumps({**entry, "payload": "A" * (2 << 20)}) + "\n")
    assert read(path).received["map"].total_bytes == 3 << 19


def test_an_overlong_line_is_a_single_problem(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(report_recording, "MAX_LINE_BYTES", 100)
    path = tmp_path / "r.jsonl"
    path.write_text("\n".join([header("a", 0.0), "x" * 1000, line(ITEMS[0])]) + "\n")
    recording = read(path)
    assert (recording.invalid_lines, len(recording.online)) == (1, 1)


def test_json_output_contains_the_figures_of_the_page(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "base.jsonl"
    path.write_bytes(b"\n".join(lines(*ITEMS)) + b"\n{\n" * 7)
    assert main([str(path), "--out", str(tmp_path / "page.html"), "--json"]) == 0
    captured = capsys.readouterr()
    value = json.loads(captured.out)
    assert value["page"] == str(tmp_path / "page.html")
    assert value["recordings"][0]["received"] == [{"topic": "telemetry", "priority": 3, "messages": 1, "bytes": 1000}]
    assert value["recordings"][0]["online"] == [{"peer": "spot1", "share": 1.0, "spans_s": [[1.0, 3.0]]}]
    assert captured.err.splitlines()[-1] == "udp-mesh: warning: ... and 2 more invalid lines"


def test_an_unwritable_page_is_reported_and_leaves_no_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, taken = tmp_path / "base.jsonl", tmp_path / "taken"
    path.write_bytes(b"\n".join(lines(*ITEMS)))
    taken.mkdir()
    assert main([str(path), "--out", str(taken)]) == 2
    assert main([str(path), "--out", str(tmp_path / "none" / "page.html")]) == 2
    assert capsys.readouterr().err == (
        f"udp-mesh: {taken}: Is a directory\nudp-mesh: {tmp_path}/none/page.html: No such file or directory\n"
    )
    assert sorted(tmp_path.iterdir()) == [path, taken]


def test_topics_are_sorted_by_message_count_and_show_punctuality() -> None:
    often = [
        RecordedArrival(i + (0.2 if i % 10 == 0 else 0.0), "base", "spot1", "telemetry", 3, 100) for i in range(100)
    ]
    seldom = [RecordedArrival(i * 4.0, "base", "spot2", "artifact", 2, 100) for i in range(25)]
    first, second = intervals(parse(lines(*often, *seldom), "r"))
    assert (first.topic, second.topic) == ("telemetry", "artifact")
    # each late one makes its own interval longer and the next one shorter
    assert first.punctual == pytest.approx(80 / 99)
    assert second.punctual == 1.0


def test_messages_that_all_come_at_once_are_not_periodic() -> None:
    burst = [RecordedArrival(5.0, "base", "spot1", "map", 7, 100) for _ in range(30)]
    assert intervals(parse(lines(*burst), "r")) == []


def test_an_invalid_recording_is_an_error_with_its_line(tmp_path: Path) -> None:
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
            text_of(document_of(parse([*start, *raw], "r")))
        except RecordingError as error:
            assert str(error).startswith("r:1:")


@given(
    st.recursive(
        st.none() | st.booleans() | st.floats() | st.text(), lambda c: st.lists(c) | st.dictionaries(st.text(), c)
    )
)
def test_arbitrary_json_values_of_a_known_kind_are_handled(value: object) -> None:
    for kind in ("received", "peer-online", "conditions", "place"):
        entry = {"t": value, "kind": kind, "peer": value, "peers": value, "x": value, "y": 1, "source": value}
        document_of(parse([header("x", 0.0).encode(), json.dumps(entry).encode()], "r"))


def periodic(jitter: float) -> Recording:
    items = [RecordedArrival(i + (jitter if i % 2 else 0.0), "base", "spot1", "telemetry", 3, 100) for i in range(100)]
    return parse(lines(*items), "r")


def test_intervals_have_median_deviation_and_gaps() -> None:
    (steady,) = intervals(periodic(0.0))
    assert (steady.median_s, steady.deviation_s, steady.gaps) == (1.0, 0.0, 0)
    (jittered,) = intervals(periodic(0.1))
    assert jittered.deviation_s == pytest.approx(0.1, abs=0.01)
    lonely = parse(lines(*[RecordedArrival(t, "base", "s", "t", 1, 1) for t in [*range(30), *range(100, 130)]]), "r")
    assert intervals(lonely)[0].gaps == 1


def test_connections_have_online_spans_and_an_online_share() -> None:
    recording = parse(lines(*ITEMS, Presence(5.0, "base", "spot1", True), Place(9.0, "base", 0, 0)), "r")
    spot = recording.online["spot1"]
    assert spot.spans_s == [(1.0, 3.0), (5.0, 9.0)]
    assert online_share(spot, recording.end_s) == 6 / 8
    assert (spot.times_lost, spot.longest_gap_s) == (1, 2.0)


@given(st.lists(st.floats(0, 2), min_size=1))
def test_a_histogram_is_a_density(values: list[float]) -> None:
    inside = sum(0 <= value < 2 for value in values)
    assert sum(histogram(Distribution.of(values), 0.0, 2.0, 8)) * 0.25 == pytest.approx(inside / len(values))


def test_without_meshctl_the_report_is_text_and_a_page_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "base.jsonl"
    path.write_bytes(b"\n".join(lines(*ITEMS)))
    assert main([str(path), "--text"]) == 0
    text = capsys.readouterr().out
    # as in a robot's bundle, which has udp_mesh alone
    monkeypatch.setattr("udp_mesh.report.page.GROUP", "udp_mesh.none")
    monkeypatch.chdir(tmp_path)
    assert main([str(path)]) == 0
    assert capsys.readouterr().out == text
    assert "telemetry" in text
    assert "spot1" in text
    assert main([str(path), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["page"] is None
    assert main([str(path), "--out", "run.html"]) == 2
    assert "the page needs meshctl" in capsys.readouterr().err
    assert [kept.name for kept in tmp_path.iterdir()] == ["base.jsonl"]


def test_a_page_never_replaces_a_recording(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "base.jsonl"
    path.write_bytes(b"\n".join(lines(*ITEMS)))
    before = path.read_bytes()
    assert main([str(path), "--out", str(path)]) == 2
    assert "expected another file" in capsys.readouterr().err
    assert path.read_bytes() == before


def test_text_has_no_control_characters_of_names() -> None:
    hostile = RecordedArrival(1.0, "base", "\x1b[2Jspot", "to\npic\x1b]0;x\x07", 3, 10)
    text = text_of(document_of(parse(lines(hostile), "r")))
    assert "\x1b" not in text
    assert "\x07" not in text
    assert "to␊pic" in text


def snapshot(t: float, **rows: object) -> bytes:
    return json.dumps({"t": t, "kind": "conditions", "peers": [], **rows}).encode()


def versions(topic: str, whole: int, differences: int, payload: int, body: int) -> dict[str, object]:
    names = ("whole_sent", "differences_sent", "payload_bytes_sent", "body_bytes_sent")
    return {"topic": topic, **dict(zip(names, (whole, differences, payload, body), strict=True))}


def test_the_gain_of_differences_is_that_of_the_recording_alone() -> None:
    recording = parse(
        [
            header("husky", 0.0).encode(),
            snapshot(0.0, versions=[versions("map", 3, 5, 8_000_000, 4_000_000), versions("idle", 1, 1, 10, 10)]),
            snapshot(1.0, versions=[versions("map", 4, 14, 18_000_000, 5_000_000), versions("late", 1, 0, 1000, 900)]),
        ],
        "r.jsonl",
    )
    assert recording.problems == []
    assert summary(recording)["differences"] == [
        {"topic": "late", "whole": 1, "differences": 0, "payload_bytes": 1000, "body_bytes": 900},
        {"topic": "map", "whole": 1, "differences": 9, "payload_bytes": 10_000_000, "body_bytes": 1_000_000},
    ]
    shown = next(table for table in document_of(recording)["tables"] if table["title"] == "Differences sent")
    assert ["map", "1", "9", "10.00", "1.00", "90%"] in shown["rows"]
    assert [row[0] for row in shown["rows"]] == ["late", "map"]


def test_what_peers_were_not_sent_is_that_of_the_recording_alone() -> None:
    def peers(**saved: tuple[int, int]) -> list[dict[str, object]]:
        return [{"name": name, "saved_messages": count, "saved_bytes": size} for name, (count, size) in saved.items()]

    def conditions(t: float, **saved: tuple[int, int]) -> bytes:
        return json.dumps({"t": t, "kind": "conditions", "peers": peers(**saved)}).encode()

    recording = parse(
        [
            header("husky", 0.0).encode(),
            conditions(0.0, base=(10, 1_000_000), idle=(3, 300)),
            conditions(1.0, base=(14, 3_500_000), idle=(3, 300), late=(1, 10_000)),
        ],
        "r.jsonl",
    )
    assert recording.problems == []
    assert summary(recording)["saved"] == [
        {"peer": "base", "messages": 4, "bytes": 2_500_000},
        {"peer": "late", "messages": 1, "bytes": 10_000},
    ]
    shown = next(table for table in document_of(recording)["tables"] if table["title"] == "Not sent")
    assert shown["rows"] == [["base", "4", "2.50"], ["late", "1", "0.01"]]


def test_shared_logs_are_shown_as_they_were_last() -> None:
    rows = [{"topic": "artifact", "source": "<spot>", "received_items": 3, "known_items": 5, "held_bytes": 2_000_000}]
    recording = parse([header("base", 0.0).encode(), snapshot(0.0), snapshot(1.0, logs=rows)], "r.jsonl")
    assert summary(recording)["logs"] == rows
    title = "Shared logs at the end"
    shown = next(table for table in document_of(recording)["tables"] if table["title"] == title)
    assert shown["rows"] == [["artifact", "<spot>", "3 of 5", "2.00"]]
    assert title not in {table["title"] for table in document_of(parse(lines(*ITEMS), "r.jsonl"))["tables"]}


def thin(t: float, *, sent: int, present: bool = True, up: bool = True, queued: int = 0) -> bytes:
    counters = {
        "bytes_sent": 100 * sent,
        "frames_sent": sent,
        "frames_received": 2 * sent,
        "frames_forged": 1,
        "frames_rejected": sent // 10,
        "parts_repeated": 0,
        "messages_given_up": 0,
        "messages_dropped": 0,
    }
    link = {"name": "<lora>", "up": up, "airtime_s": 0.5 * sent, "queued_messages": queued, **counters}
    peers = [{"name": "husky", "present": present, "only_thin": True}, {"name": "never", "present": False}]
    return snapshot(t, thin={"links": [link], "peers": peers})


def test_thin_links_are_shown_with_their_airtime_and_who_was_present() -> None:
    recording = parse(
        [
            header("base", 0.0).encode(),
            thin(0.0, sent=100, present=False),
            thin(10.0, sent=102, queued=7),
            thin(20.0, sent=110, present=False, up=False),
            thin(40.0, sent=110),
        ],
        "r.jsonl",
    )
    assert recording.problems == []
    (link,) = summary(recording)["thin_links"]
    assert (link["link"], link["seconds"], link["up"], link["most_queued"]) == ("<lora>", 40.0, 0.75, 7)
    assert (link["airtime_s"], link["frames_sent"], link["frames_received"], link["frames_rejected"]) == (
        5.0,
        10,
        20,
        1,
    )
    assert link["frames_forged"] == 0
    (present,) = summary(recording)["thin_present"]
    assert (present["peer"], present["spans_s"]) == ("husky", [[10.0, 20.0], [40.0, 40.0]])
    document = document_of(recording)
    tables = {table["title"]: table["rows"] for table in document["tables"]}
    assert tables["Thin links"] == [
        ["<lora>", "75.0%", "5.0", "12.50%", "10", "1.0", "20", "1", "0", "0", "0", "7"],
    ]
    assert tables["Present on thin links"] == [["husky", "33.3%", "1", "20.0"]]
    (chart,) = (chart for chart in document["charts"] if chart["title"] == "Airtime used on thin links")
    (line,) = chart["series"]
    assert line["label"] == "<lora>"
    assert max(value for value in line["values"] if value is not None) == 40.0


@pytest.mark.parametrize(
    "rows",
    [
        *({"versions": 5}, {"logs": [1]}, {"versions": [{"topic": "map"}]}, {"logs": [{}]}),
        *({"thin": 5}, {"thin": {}}, {"thin": {"links": [{"name": "lora"}], "peers": []}}),
        {"thin": {"links": [], "peers": [{"name": "husky", "present": 1}]}},
    ],
)
def test_invalid_counters_are_reported_with_their_line(rows: dict[str, object]) -> None:
    recording = parse([header("base", 0.0).encode(), snapshot(0.0, **rows)], "r.jsonl")
    assert [problem.split()[0] for problem in recording.problems] == ["r.jsonl:2:"]
