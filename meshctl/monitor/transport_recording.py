"""Recordings of udp-mesh (docs/recording-format.md) as robots of frames: what a robot recorded itself, also while
out of reach.

`read_recording` parses one file; `frames_of` makes frames of recordings alone; `with_recorded` adds to a frame of a
history what robots recorded that did not answer then. Lines of an unknown kind are skipped, as is a truncated last one.
"""

from __future__ import annotations

import json
from bisect import bisect_right
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from meshctl.errors import InputError
from meshctl.monitor.frame import Frame, links_of

FORMAT = 1
# A sample says nothing about a moment that is this much later: `conditions_period_s` is seconds.
MAX_AGE_S = 15.0
# Frames of recordings alone are at least this far apart.
STEP_S = 1.0
_BASE_NAMES = ("base", "base-station", "basestation")
_PEER_KEYS = ("name", "online", "heard_ago_s", "round_trip_s", "loss", "outbox_messages", "capacity_bits_per_s")


@dataclass(slots=True)
class RecordedRobot:
    """One robot's samples in ascending order: times, and its part of a status document at each."""

    name: str
    times_s: list[float] = field(default_factory=list)
    documents: list[dict[str, Any]] = field(default_factory=list)
    places: list[tuple[float, float, float]] = field(default_factory=list)

    def at(self, time_s: float) -> tuple[float, dict[str, Any]] | None:
        """The newest sample that is not after `time_s` and still says something, with its time."""
        index = bisect_right(self.times_s, time_s) - 1
        if index < 0 or time_s - self.times_s[index] > MAX_AGE_S:
            return None
        return self.times_s[index], self.documents[index]

    def place_at(self, time_s: float) -> dict[str, Any] | None:
        index = bisect_right(self.places, (time_s, float("inf"), float("inf"))) - 1
        if index < 0:
            return None
        seen_s, x_m, y_m = self.places[index]
        return {"x_m": x_m, "y_m": y_m, "z_m": None, "age_s": round(time_s - seen_s, 3), "source": "daemon"}


class _Topics:
    """When one robot last sent and received each topic."""

    def __init__(self) -> None:
        self._last: dict[str, dict[str, Any]] = {}

    def note(self, entry: Mapping[str, Any], key: str, time_s: float) -> None:
        topic = entry.get("topic")
        if isinstance(topic, str):
            self._last.setdefault(topic, {"priority": entry.get("priority")})[key] = time_s

    def at(self, time_s: float) -> list[dict[str, Any]]:
        def ago_s(seen: Mapping[str, Any], key: str) -> float | None:
            return round(time_s - seen[key], 3) if key in seen else None

        return [
            {
                "name": name,
                "priority": seen["priority"],
                "sent_ago_s": ago_s(seen, "sent"),
                "received_ago_s": ago_s(seen, "received"),
                "limit_s": None,
                "trouble": None,
            }
            for name, seen in sorted(self._last.items(), key=lambda item: (_number(item[1]["priority"]) or 0, item[0]))
        ]


def read_recording(file: Path) -> list[RecordedRobot]:
    """The robots of one recording; a simulation's has several. Raises InputError with file and line."""
    robots: dict[str, RecordedRobot] = {}
    topics: dict[str, _Topics] = defaultdict(_Topics)
    try:
        with file.open(encoding="utf-8", errors="replace") as lines:
            node, started_s = _header(file, lines.readline())
            for entry in _entries(file, lines):
                elapsed_s = _number(entry.get("t"))
                if elapsed_s is None:
                    continue
                time_s, name = started_s + elapsed_s, str(entry.get("at", node))
                robot = robots.setdefault(name, RecordedRobot(name))
                match entry.get("kind"):
                    case "sent" | "received" as kind:
                        topics[name].note(entry, kind, time_s)
                    case "conditions":
                        robot.times_s.append(time_s)
                        robot.documents.append(_robot(name, entry, topics[name].at(time_s)))
                    case "place":
                        x_m, y_m = _number(entry.get("x")), _number(entry.get("y"))
                        if x_m is not None and y_m is not None:
                            robot.places.append((time_s, x_m, y_m))
    except OSError as error:
        raise InputError(f"cannot read {file}: {error.strerror}") from error
    found = [robot for robot in robots.values() if robot.times_s]
    if not found:
        raise InputError(f"{file}: expected lines of kind conditions, found none")
    return found


def _header(file: Path, line: str) -> tuple[str, float]:
    try:
        header = json.loads(line)
    except ValueError:
        header = None
    hint = "expected a history of `meshctl monitor`, or a recording of `udp-mesh record start`"
    if not isinstance(header, dict) or header.get("recording") != FORMAT:
        raise InputError(f"{file}: line 1: expected the header of a recording of version {FORMAT}", hint=hint)
    started_s = _number(header.get("started"))
    if not isinstance(header.get("node"), str) or started_s is None:
        raise InputError(f"{file}: line 1: expected node and started", hint=hint)
    return header["node"], started_s


def _entries(file: Path, lines: Iterable[str]) -> Iterator[Mapping[str, Any]]:
    broken = 0
    for number, line in enumerate(lines, 2):
        # only the last line may be truncated
        if broken:
            raise InputError(f"{file}: line {broken}: expected a JSON object")
        try:
            entry = json.loads(line)
        except (ValueError, RecursionError):
            entry = None
        if isinstance(entry, dict):
            yield entry
        elif line.strip():
            broken = number


def _robot(name: str, entry: Mapping[str, Any], topics: list[dict[str, Any]]) -> dict[str, Any]:
    peers = [peer for peer in entry.get("peers") or () if isinstance(peer, dict)]
    queues: dict[int, dict[str, Any]] = {}
    for peer in peers:
        for queue in peer.get("queues") or ():
            if not isinstance(queue, dict) or not isinstance(queue.get("priority"), int):
                continue
            priority = queue["priority"]
            total = queues.setdefault(priority, {"priority": priority, "messages": 0, "bytes": 0, "oldest_s": 0.0})
            total["messages"] += int(_number(queue.get("messages")) or 0)
            total["bytes"] += int(_number(queue.get("bytes")) or 0)
            total["oldest_s"] = max(total["oldest_s"], _number(queue.get("oldest_s")) or 0.0)
    return {
        "name": name,
        "is_base": name in _BASE_NAMES,
        "radios": [name],
        "alarms": [],
        "peers": [{key: peer.get(key) for key in _PEER_KEYS} for peer in peers],
        "queues": [queues[priority] for priority in sorted(queues)],
        "topics": topics,
        "recorded": True,
    }


def frames_of(robots: Sequence[RecordedRobot]) -> Iterator[Frame]:
    """Frames of recordings alone. Robots are drawn as devices, with the peers that they hear as links."""
    times = sorted({round(time_s / STEP_S) * STEP_S for robot in robots for time_s in robot.times_s})
    for time_s in times:
        sampled = {robot.name: robot.at(time_s + STEP_S / 2) for robot in robots}
        documents = {name: found[1] for name, found in sampled.items() if found is not None}
        base = next((name for name, document in documents.items() if document["is_base"]), None)
        nodes = [_node(robot.name, documents.get(robot.name), base) for robot in robots]
        status = {
            "version": 1,
            "fleet": "recording",
            "taken_s": time_s,
            "entry": base,
            "alarms": [],
            "nodes": nodes,
            "robots": [
                {**documents[robot.name], "health": "ok", "answers": True, "age_s": 0.0}
                if robot.name in documents
                else {"name": robot.name, "health": "unreachable", "answers": False, "alarms": []}
                for robot in robots
            ],
        }
        places = {robot.name: robot.place_at(time_s) for robot in robots}
        yield Frame.of(
            {
                "schema": 1,
                "time_s": time_s,
                "fleet": "recording",
                "verdict": None,
                "status": status,
                "links": links_of(status),
                "radios": {},
                "positions": {name: place for name, place in places.items() if place is not None},
                "airtime": None,
            }
        )


def _node(name: str, document: Mapping[str, Any] | None, base: str | None) -> dict[str, Any]:
    peers = () if document is None else [peer for peer in document["peers"] if peer.get("online")]
    hears_base = any(peer["name"] == base for peer in peers)
    return {
        "name": name,
        "role": "base" if name == base else "robot",
        "robot": name,
        "state": "deployed",
        "health": "unreachable" if document is None else "ok",
        "answers": document is not None,
        "alarms": [],
        "age_s": None if document is None else 0.0,
        "hops": 0 if name == base else 1 if hears_base else None,
        "via": base if hears_base else None,
        "neighbours": [
            {
                "name": peer["name"],
                "age_s": _number(peer.get("heard_ago_s")) or 0.0,
                "quality": None if (loss := _number(peer.get("loss"))) is None else round(1 - loss, 3),
                "signal_dbm": None,
            }
            for peer in peers
        ],
    }


def with_recorded(frame: Frame, robots: Sequence[RecordedRobot]) -> Frame:
    """The frame with what robots recorded that did not answer then, each marked `recorded`."""
    known = {robot.name: robot for robot in robots}
    changed = False
    merged: list[Any] = []
    for one in frame.status.get("robots") or ():
        recorded = known.get(str(one.get("name"))) if isinstance(one, dict) and one.get("answers") is False else None
        found = None if recorded is None else recorded.at(frame.time_s)
        if found is None:
            merged.append(one)
            continue
        changed = True
        seen_s, document = found
        facts = {key: document[key] for key in ("peers", "queues", "topics", "recorded")}
        merged.append({**one, **facts, "age_s": round(frame.time_s - seen_s, 3)})
    places = {
        robot.name: place
        for robot in robots
        if (place := robot.place_at(frame.time_s)) is not None and robot.name not in frame.document.get("positions", {})
    }
    if not changed and not places:
        return frame
    positions = {**frame.document.get("positions", {}), **places}
    return Frame.of({**frame.document, "status": {**frame.status, "robots": merged}, "positions": positions})


def _number(value: object) -> float | None:
    if not isinstance(value, int | float) or isinstance(value, bool):
        return None
    return float(value) if abs(value) < 1e15 else None
