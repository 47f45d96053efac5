"""The recording of a run: one JSON object per line, written while it happens, readable after a crash.

The first line is `{"recording": 1, "node": ..., "started": UNIX_TIME}`; every other line has `t` (seconds since the
start), `kind`, and `at` (whose view it is) where that is not the node of the first line. Read here are the kinds

- `received`: `source`, `topic`, `priority`, `bytes`,
- `peer-online`, `peer-offline`: `peer`,
- `conditions`: `peers`, a list of `name`, `round_trip_s`, `loss`, `received_bits_per_s`, `hops` (each may be absent),
- `place`: `x`, `y` in metres (simulated runs);

others (`sent`, further events) are passed over.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

VERSION = 1
# longer lines are no line of ours
MAX_LINE_BYTES = 1 << 20
_SAMPLED = ("round_trip_s", "loss", "received_bits_per_s", "hops")


class RecordingError(ValueError):
    """A recording that cannot be read; names file, line, what was expected and what was found."""


@dataclass(frozen=True, slots=True)
class Arrival:
    t: float
    at: str
    source: str
    topic: str
    priority: int
    size: int


@dataclass(frozen=True, slots=True)
class Presence:
    t: float
    at: str
    peer: str
    online: bool


@dataclass(frozen=True, slots=True)
class Sample:
    t: float
    at: str
    peer: str
    round_trip_s: float | None = None
    loss: float | None = None
    received_bits_per_s: float | None = None
    hops: int | None = None


@dataclass(frozen=True, slots=True)
class Place:
    t: float
    at: str
    x: float
    y: float


@dataclass(slots=True)
class Recording:
    """Everything in one recording, in its order. `problems` are lines that were left out, and why."""

    name: str = ""
    started: float = 0.0
    arrivals: list[Arrival] = field(default_factory=list)
    presences: list[Presence] = field(default_factory=list)
    samples: list[Sample] = field(default_factory=list)
    places: list[Place] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)

    @property
    def end_s(self) -> float:
        """The time of the last line."""
        return max(
            (items[-1].t for items in (self.arrivals, self.presences, self.samples, self.places) if items), default=0.0
        )


def header(name: str, started: float) -> str:
    return json.dumps({"recording": VERSION, "node": name, "started": started})


def line(item: Arrival | Presence | Sample | Place) -> str:
    """One line, without its end."""
    match item:
        case Arrival(_, _, source, topic, priority, size):
            kind = "received"
            what: dict[str, Any] = {"source": source, "topic": topic, "priority": priority, "bytes": size}
        case Presence(_, _, peer, online):
            kind = "peer-online" if online else "peer-offline"
            what = {"peer": peer}
        case Sample():
            kind = "conditions"
            known = {name: getattr(item, name) for name in _SAMPLED if getattr(item, name) is not None}
            what = {"peers": [{"name": item.peer, **known}]}
        case Place(_, _, x, y):
            kind = "place"
            what = {"x": round(x, 1), "y": round(y, 1)}
    return json.dumps({"t": round(item.t, 6), "kind": kind, "at": item.at, **what})


def read(path: Path) -> Recording:
    """Read a recording. Raises RecordingError when it is none at all; a torn or foreign line becomes a problem."""
    try:
        with path.open("rb") as file:
            return parse(file, str(path))
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror}") from error


def parse(lines: Iterable[bytes], file: str) -> Recording:
    """As `read`, from the lines themselves."""
    numbered = _objects(lines)
    _, first = next(numbered, (0, None))
    if not isinstance(first, dict) or "recording" not in first:
        raise RecordingError(f'{file}:1: expected {{"recording": {VERSION}, ...}}, found something else')
    if first["recording"] != VERSION:
        raise RecordingError(f"{file}:1: expected version {VERSION}, found {first['recording']!r}")
    started = first.get("started")
    recording = Recording(str(first.get("node", "")), float(started) if isinstance(started, int | float) else 0.0)
    for number, entry in numbered:
        try:
            _take(recording, entry)
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            recording.problems.append(
                f"{file}:{number}: expected a recording's line, found {type(error).__name__} in it: {error}"
            )
    return recording


def _objects(lines: Iterable[bytes]) -> Iterator[tuple[int, Any]]:
    for number, raw in enumerate(lines, 1):
        if not raw.strip():
            continue
        try:
            yield number, json.loads(raw) if len(raw) <= MAX_LINE_BYTES else None
        except ValueError:
            yield number, None


def _take(recording: Recording, entry: Any) -> None:
    t, kind, at = float(entry["t"]), entry["kind"], str(entry.get("at", recording.name))
    match kind:
        case "received":
            recording.arrivals.append(
                Arrival(t, at, str(entry["source"]), str(entry["topic"]), int(entry["priority"]), int(entry["bytes"]))
            )
        case "peer-online" | "peer-offline":
            recording.presences.append(Presence(t, at, str(entry["peer"]), kind == "peer-online"))
        case "conditions":
            for peer in entry["peers"]:
                known = {name: peer.get(name) for name in _SAMPLED}
                recording.samples.append(Sample(t, at, str(peer["name"]), **known))
        case "place":
            recording.places.append(Place(t, at, float(entry["x"]), float(entry["y"])))
        case _:
            # another kind, which no picture shows
            return
