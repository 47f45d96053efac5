"""Recordings of udp-mesh as frames, alone and merged into a history."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from meshctl.errors import InputError
from meshctl.monitor.frame import Frame
from meshctl.monitor.recorded_frames import MAX_FRAMES
from meshctl.monitor.replay import open_recordings
from meshctl.monitor.store import MIN_BYTES, FrameStore

PEER = {
    "name": "base",
    "online": True,
    "heard_ago_s": 0.2,
    "round_trip_s": 0.03,
    "loss": 0.25,
    "outbox_messages": 2,
    "queues": [{"priority": 3, "messages": 4, "bytes": 90, "oldest_s": 1.5}],
}
HEADER = {"recording": 1, "node": "spot1", "boot": "b", "started": 1000.0, "payloads": False}
LINES: list[dict[str, Any]] = [
    {"t": 0.5, "kind": "sent", "topic": "telemetry", "priority": 3, "bytes": 10, "to": None, "reliable": False},
    {"t": 1.0, "kind": "conditions", "name": "spot1", "peers": [PEER, {**PEER, "name": "husky1", "online": False}]},
    {"t": 1.5, "kind": "place", "x": 3.0, "y": 4.0},
    {"t": 2.0, "kind": "some-later-kind"},
    {"t": 3.0, "kind": "conditions", "name": "spot1", "peers": []},
]


def written(path: Path, *lines: object, tail: str = "") -> Path:
    path.write_text("".join(json.dumps(line) + "\n" for line in lines) + tail)
    return path


def test_a_recording_alone_becomes_frames(tmp_path: Path) -> None:
    file = written(tmp_path / "spot1.jsonl", HEADER, *LINES, tail='{"t": 4.0, "kind": "cond')
    with open_recordings([file], tmp_path) as opened:
        frames = list(opened.store.after(0.0))
        assert [frame.time_s for frame in frames] == [1001.0, 1003.0]
        robot, base, husky = frames[0].status["robots"]
        # they recorded nothing themselves
        assert (base["health"], base["answers"]) == ("ok", None)
        assert (husky["health"], husky["answers"], husky["age_s"]) == ("unreachable", False, 0.2)
        # two peers, each with a queue
        assert robot["queues"] == [{"priority": 3, "messages": 8, "bytes": 180, "oldest_s": 1.5}]
        assert robot["topics"][0]["sent_ago_s"] == 0.5
        assert robot["peers"][0]["round_trip_s"] == 0.03
        (link,) = frames[0].document["links"]
        assert (link["from"], link["to"], link["quality"]) == ("base", "spot1", 0.75)
        assert frames[1].document["positions"]["spot1"]["x_m"] == 3.0
        assert opened.fleet == "recording"
        assert opened.problems == (f"{file}: line 7: expected a JSON object; ignored",)


def test_a_history_gains_what_a_robot_recorded_while_it_did_not_answer(tmp_path: Path) -> None:
    def robot(name: str, *, answers: bool) -> dict[str, Any]:
        health = "ok" if answers else "unreachable"
        return {"name": name, "answers": answers, "health": health, "peers": None, "queues": None, "alarms": []}

    history = tmp_path / "run.sqlite"
    with FrameStore.open(history, 1e9, MIN_BYTES) as store:
        for time_s in (1001.5, 1002.5, 1100.0):
            robots = [robot("spot1", answers=time_s == 1002.5), robot("husky1", answers=False)]
            store.append(Frame.of({"time_s": time_s, "fleet": "lab", "status": {"nodes": [], "robots": robots}}))
    file = written(tmp_path / "spot1.jsonl", HEADER, *LINES)
    with open_recordings([history, file], tmp_path) as opened:
        first, second, last = opened.store.after(0.0)
        assert opened.fleet == "lab"
        spot, husky = first.status["robots"]
        assert (spot["recorded"], spot["answers"], spot["health"]) == (True, False, "unreachable")
        assert (spot["queues"][0]["messages"], spot["age_s"]) == (8, 0.5)
        assert husky["queues"] is None
        # it answered, and later its recording has nothing new
        assert "recorded" not in second.status["robots"][0]
        assert "recorded" not in last.status["robots"][0]


@pytest.mark.parametrize(
    ("lines", "expected"),
    [
        ([], "line 1: expected the header of a recording of version 1"),
        ([{"recording": 2}], "line 1: expected the header of a recording of version 1"),
        ([{"recording": 1}], "line 1: expected node and started"),
    ],
)
def test_what_is_no_recording_is_named(lines: list[object], expected: str, tmp_path: Path) -> None:
    file = written(tmp_path / "broken.jsonl", *lines)
    with pytest.raises(InputError) as raised, open_recordings([file], tmp_path):
        pass
    assert expected in str(raised.value)
    assert str(file) in str(raised.value)


def frames_of(tmp_path: Path, *files: Path) -> list[Frame]:
    with open_recordings(files, tmp_path) as opened:
        return list(opened.store.after(0.0))


def test_a_damaged_line_in_the_middle_costs_that_line_alone(tmp_path: Path) -> None:
    whole = frames_of(tmp_path, written(tmp_path / "whole.jsonl", HEADER, *LINES))
    (tmp_path / "merged.sqlite").unlink()
    damaged = written(tmp_path / "damaged.jsonl", HEADER, 7, *LINES, "x")
    with open_recordings([damaged], tmp_path) as opened:
        assert list(opened.store.after(0.0)) == whole
        assert opened.problems == (f"{damaged}: line 2 (and 1 more): expected a JSON object; ignored",)


def test_a_simulation_records_each_peer_in_a_line_of_its_own(tmp_path: Path) -> None:
    head = {"recording": 1, "node": "base", "started": 100.0}
    lines = [
        {"t": 1.0, "kind": "peer-online", "at": "base", "peer": "spot1"},
        {"t": 2.0, "kind": "conditions", "at": "base", "peers": [{"name": "spot1", "loss": 0.25, "hops": 2}]},
        {"t": 2.0, "kind": "conditions", "at": "base", "peers": [{"name": "spot2"}]},
        {"t": 2.0, "kind": "place", "at": "spot1", "x": 7.0, "y": 1.0},
        {"t": 2.5, "kind": "place", "at": "beacon1", "x": 9.0, "y": 1.0},
        {"t": 4.0, "kind": "conditions", "at": "base", "peers": []},
    ]
    second, last = (
        one for one in frames_of(tmp_path, written(tmp_path / "r.jsonl", head, *lines)) if one.time_s > 101.0
    )
    base = second.status["robots"][0]
    assert [(peer["name"], peer["online"]) for peer in base["peers"]] == [("spot1", True), ("spot2", False)]
    assert base["queues"] is None
    nodes = {node["name"]: node for node in second.status["nodes"]}
    assert (nodes["spot1"]["health"], nodes["spot1"]["hops"], nodes["spot1"]["via"]) == ("ok", 2, None)
    assert nodes["spot2"]["health"] == "unreachable"
    # how long ago is not in the recording
    (link,) = second.document["links"]
    assert (link["from"], link["quality"], link["age_s"]) == ("spot1", 0.75, None)
    assert second.document["positions"]["spot1"]["x_m"] == 7.0
    # what has only a place is no robot
    assert [(node["name"], node["role"]) for node in last.status["nodes"]][-1] == ("spot2", "robot")
    assert ("beacon1", "beacon") in [(node["name"], node["role"]) for node in last.status["nodes"]]
    assert "beacon1" not in [robot["name"] for robot in last.status["robots"]]


def test_recordings_without_conditions_show_what_they_have(tmp_path: Path) -> None:
    (empty,) = frames_of(tmp_path, written(tmp_path / "empty.jsonl", HEADER))
    assert [node["name"] for node in empty.status["nodes"]] == ["spot1"]
    (tmp_path / "merged.sqlite").unlink()
    events = [{"t": 0.5, "kind": "peer-online", "peer": "base"}, LINES[0], {"t": 8.0, "kind": "received"}]
    frames = frames_of(tmp_path, written(tmp_path / "events.jsonl", HEADER, *events))
    assert [frame.time_s for frame in frames] == [1000.0, 1008.0]
    assert frames[1].document["links"][0]["from"] == "base"


def test_two_recordings_of_one_robot_are_one_robot(tmp_path: Path) -> None:
    first = written(tmp_path / "1.jsonl", HEADER, *LINES)
    second = written(tmp_path / "2.jsonl", {**HEADER, "started": 1060.0}, *LINES)
    frames = frames_of(tmp_path, second, first)
    assert [frame.time_s for frame in frames] == [1001.0, 1003.0, 1061.0, 1063.0]
    assert all(len([n for n in frame.status["nodes"] if n["name"] == "spot1"]) == 1 for frame in frames)


def test_hours_become_at_most_a_fixed_number_of_frames(tmp_path: Path) -> None:
    entries = [{"t": float(t), "kind": "conditions", "peers": []} for t in range(0, 4 * 3600, 2)]
    frames = frames_of(tmp_path, written(tmp_path / "long.jsonl", HEADER, *entries))
    assert 3000 < len(frames) <= MAX_FRAMES + 1
    assert frames[-1].time_s >= 1000.0 + 4 * 3600 - 4
