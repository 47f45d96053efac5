"""Recordings of udp-mesh (docs/recording-format.md): what a robot recorded itself, also while out of reach.

`read_recording` parses one file into `RecordedRobot`s, whose samples are in a file of their own. Damaged lines and
lines of an unknown kind are skipped; `recorded_frames` makes frames of the robots.
"""

from __future__ import annotations

import json
import statistics
import zlib
from array import array
from bisect import bisect_right
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

from meshctl.errors import InputError, MeshctlError

FORMAT = 1
# A sample says nothing about a moment that is this much later, or 2.5 of the recording's periods if that is more.
MAX_AGE_S = 15.0
PERIODS = 2.5
# Without conditions, events and messages are samples, at most one in this time.
SAMPLE_S = 1.0
# Of each robot's samples, about so many of the time until then are kept, twice as many as become frames.
MAX_MOMENTS = 7200
MAX_PLACE_M = 1e7
BASE_NAMES = ("base", "base-station", "basestation")
_PEER_KEYS = (
    *("name", "online", "heard_ago_s", "round_trip_s", "loss", "outbox_messages", "capacity_bits_per_s", "hops"),
)


class SampleFile:
    """Packed samples on the disk, since hours of a large team do not fit into memory. The file has no name: it is gone
    with the process, however that ends."""

    def __init__(self, directory: Path) -> None:
        """Raises OSError."""
        self._file = TemporaryFile(dir=directory)  # noqa: SIM115 - closed by __exit__
        self._directory = directory
        self._end = 0

    def __enter__(self) -> SampleFile:
        return self

    def __exit__(self, *exc: object) -> None:
        self._file.close()

    def add(self, document: Mapping[str, Any]) -> int:
        """Where it is. Raises MeshctlError."""
        packed = zlib.compress(json.dumps(document, separators=(",", ":")).encode(), 1)
        at = self._end
        try:
            self._file.seek(at)
            self._file.write(len(packed).to_bytes(4, "big") + packed)
        except OSError as error:
            raise MeshctlError(
                f"{self._directory.parent}: cannot write temporary files: {error.strerror}", hint="free space there"
            ) from error
        self._end += 4 + len(packed)
        return at

    def read(self, at: int) -> dict[str, Any]:
        self._file.seek(at)
        size = int.from_bytes(self._file.read(4), "big")
        found: dict[str, Any] = json.loads(zlib.decompress(self._file.read(size)))
        return found


def _numbers() -> array[float]:
    return array("d")


@dataclass(slots=True)
class RecordedRobot:
    """One robot's samples in ascending order: times, and its part of a status document at each, in a file. A robot that
    others saw alone has places and no samples."""

    name: str
    samples: SampleFile
    times_s: array[float] = field(default_factory=_numbers)
    peer_names: set[str] = field(default_factory=set)
    _at: array[int] = field(default_factory=lambda: array("Q"))
    _places_s: array[float] = field(default_factory=_numbers)
    _places_x_m: array[float] = field(default_factory=_numbers)
    _places_y_m: array[float] = field(default_factory=_numbers)
    _max_age_s: float = MAX_AGE_S

    def add(self, time_s: float, document: Mapping[str, Any]) -> None:
        self.times_s.append(time_s)
        self._at.append(self.samples.add(document))
        self.peer_names.update(peer["name"] for peer in document["peers"])

    def add_place(self, time_s: float, x_m: float, y_m: float) -> None:
        self._places_s.append(time_s)
        self._places_x_m.append(x_m)
        self._places_y_m.append(y_m)

    def finish(self) -> None:
        """After the last sample."""
        if len(self.times_s) > 1:
            period_s = statistics.median(later - earlier for earlier, later in pairwise(self.times_s))
            self._max_age_s = max(MAX_AGE_S, PERIODS * period_s)

    def joined(self, other: RecordedRobot) -> RecordedRobot:
        """Both recordings of one robot."""
        found = RecordedRobot(self.name, self.samples, peer_names=self.peer_names | other.peer_names)
        for time_s, at in sorted(zip([*self.times_s, *other.times_s], [*self._at, *other._at], strict=True)):
            found.times_s.append(time_s)
            found._at.append(at)
        for place in sorted([*self._places(), *other._places()]):
            found.add_place(*place)
        found._max_age_s = max(self._max_age_s, other._max_age_s)
        return found

    def _places(self) -> Iterator[tuple[float, float, float]]:
        return zip(self._places_s, self._places_x_m, self._places_y_m, strict=True)

    def at(self, time_s: float) -> tuple[float, dict[str, Any]] | None:
        """The newest sample that is not after `time_s` and still says something, with its time."""
        index = bisect_right(self.times_s, time_s) - 1
        if index < 0 or time_s - self.times_s[index] > self._max_age_s:
            return None
        return self.times_s[index], self.samples.read(self._at[index])

    def place_at(self, time_s: float) -> dict[str, Any] | None:
        index = bisect_right(self._places_s, time_s) - 1
        if index < 0:
            return None
        age_s = round(time_s - self._places_s[index], 3)
        x_m, y_m = self._places_x_m[index], self._places_y_m[index]
        return {"x_m": x_m, "y_m": y_m, "z_m": None, "age_s": age_s, "source": "daemon"}


class _Thinning:
    """Chooses which of many moments, in ascending order, to keep: no more than are shown of the time until then."""

    def __init__(self) -> None:
        self._first_s: float | None = None
        self._next_s = 0.0

    def keeps(self, time_s: float) -> bool:
        if self._first_s is None:
            self._first_s = time_s
        elif time_s < self._next_s:
            return False
        self._next_s = time_s + (time_s - self._first_s) / MAX_MOMENTS
        return True


class _Topics:
    """When one robot last sent and received each topic."""

    def __init__(self) -> None:
        self._last: dict[str, dict[str, Any]] = {}

    def note(self, entry: Mapping[str, Any], key: str, time_s: float) -> None:
        topic = entry.get("topic")
        if isinstance(topic, str):
            self._last.setdefault(topic, {"priority": number_of(entry.get("priority"))})[key] = time_s

    def at(self, time_s: float) -> list[dict[str, Any]]:
        def ago_s(record: Mapping[str, Any], key: str) -> float | None:
            return round(time_s - record[key], 3) if key in record else None

        return [
            {
                "name": name,
                "priority": record["priority"],
                "sent_ago_s": ago_s(record, "sent"),
                "received_ago_s": ago_s(record, "received"),
                "limit_s": None,
                "trouble": None,
            }
            for name, record in sorted(self._last.items(), key=lambda item: (item[1]["priority"] or 0, item[0]))
        ]


class _Reader:
    """The lines of one robot, in ascending order -> its samples."""

    def __init__(self, name: str, samples: SampleFile) -> None:
        self.robot = RecordedRobot(name, samples)
        self._thinning, self._place_thinning = _Thinning(), _Thinning()
        self._topics = _Topics()
        self._online: dict[str, bool] = {}
        self._open: tuple[float, list[dict[str, Any]], list[dict[str, Any]]] | None = None
        self._has_conditions = False
        # samples of a recording without conditions
        self._event_robot = RecordedRobot(name, samples)

    def line(self, entry: Mapping[str, Any], time_s: float) -> None:
        match entry.get("kind"):
            case "conditions":
                self._conditions(entry, time_s)
                return
            case "place":
                x_m, y_m = number_of(entry.get("x")), number_of(entry.get("y"))
                if x_m is None or y_m is None or max(abs(x_m), abs(y_m)) > MAX_PLACE_M:
                    return
                if self._place_thinning.keeps(time_s):
                    for robot in (self.robot, self._event_robot):
                        robot.add_place(time_s, x_m, y_m)
                return
            case "sent" | "received" as kind:
                self._topics.note(entry, kind, time_s)
            case "peer-online" | "peer-offline" as kind:
                if isinstance(peer := entry.get("peer"), str):
                    self._online[peer] = kind == "peer-online"
        before_s = self._event_robot.times_s
        is_due = not before_s or time_s - before_s[-1] >= SAMPLE_S
        if not self._has_conditions and is_due and self._thinning.keeps(time_s):
            peers = [{"name": name, "online": is_online} for name, is_online in sorted(self._online.items())]
            self._event_robot.add(time_s, _document(self.robot.name, peers, self._topics.at(time_s)))

    def end(self) -> RecordedRobot:
        self._close()
        robot = self.robot if self._has_conditions else self._event_robot
        robot.finish()
        return robot

    def _conditions(self, entry: Mapping[str, Any], time_s: float) -> None:
        """A simulation writes a line for each peer, all of the same time."""
        if not self._has_conditions:
            self._has_conditions = True
            self._thinning = _Thinning()
        found = entry.get("peers")
        peers = [peer for peer in found if _is_peer(peer)] if isinstance(found, list) else []
        for peer in peers:
            peer["online"] = (
                self._online.setdefault(peer["name"], False) if "online" not in peer else bool(peer["online"])
            )
            self._online[peer["name"]] = peer["online"]
        if self._open is not None and self._open[0] == time_s:
            self._open[1].extend(peers)
            return
        self._close()
        if self._thinning.keeps(time_s):
            self._open = (time_s, peers, self._topics.at(time_s))

    def _close(self) -> None:
        if self._open is not None:
            time_s, peers, topics = self._open
            self.robot.add(time_s, _document(self.robot.name, peers, topics))
            self._open = None


def _is_peer(value: object) -> bool:
    return isinstance(value, dict) and isinstance(value.get("name"), str)


def read_recording(file: Path, samples: SampleFile, on_problem: Callable[[str], None]) -> list[RecordedRobot]:
    """The robots of one recording; a simulation's has several. `on_problem` gets one text about all damaged lines.

    Raises InputError with file and line if it is no recording.
    """
    readers: dict[str, _Reader] = {}
    problems = _Problems()
    try:
        with file.open(encoding="utf-8", errors="replace") as lines:
            node, started_s = _header(file, lines.readline())
            for entry in _entries(lines, problems):
                elapsed_s = number_of(entry.get("t"))
                if elapsed_s is None or elapsed_s < 0:
                    continue
                name = str(entry.get("at", node))
                if (reader := readers.get(name)) is None:
                    reader = readers[name] = _Reader(name, samples)
                reader.line(entry, started_s + elapsed_s)
    except OSError as error:
        raise InputError(f"cannot read {file}: {error.strerror}") from error
    if problems.count:
        more = f" (and {problems.count - 1} more)" if problems.count > 1 else ""
        on_problem(f"{file}: line {problems.first}{more}: expected a JSON object; ignored")
    found = [reader.end() for reader in readers.values()]
    if not any(robot.times_s for robot in found):
        # nothing happened, and that is shown
        empty = RecordedRobot(node, samples)
        empty.add(started_s, _document(node, [], []))
        found = [robot for robot in found if robot.name != node] + [empty]
    return found


def _header(file: Path, line: str) -> tuple[str, float]:
    try:
        header = json.loads(line)
    except (ValueError, RecursionError):
        header = None
    hint = "expected a history of `meshctl monitor`, or a recording of `udp-mesh record start`"
    if not isinstance(header, dict) or header.get("recording") != FORMAT:
        raise InputError(f"{file}: line 1: expected the header of a recording of version {FORMAT}", hint=hint)
    started_s = number_of(header.get("started"))
    if not isinstance(header.get("node"), str) or started_s is None:
        raise InputError(f"{file}: line 1: expected node and started", hint=hint)
    return header["node"], started_s


@dataclass(slots=True)
class _Problems:
    """Damaged lines: the number of the first, and how many."""

    first: int = 0
    count: int = 0


def _entries(lines: Iterable[str], problems: _Problems) -> Iterator[Mapping[str, Any]]:
    for number, line in enumerate(lines, 2):
        try:
            entry = json.loads(line)
        except (ValueError, RecursionError):
            entry = None
        if isinstance(entry, dict):
            yield entry
        elif line.strip():
            problems.first = problems.first or number
            problems.count += 1


def _document(name: str, peers: list[dict[str, Any]], topics: list[dict[str, Any]]) -> dict[str, Any]:
    queues: dict[int, dict[str, Any]] = {}
    for peer in peers:
        found = peer.get("queues")
        for queue in found if isinstance(found, list) else ():
            if not isinstance(queue, dict) or not isinstance(queue.get("priority"), int):
                continue
            priority = queue["priority"]
            total = queues.setdefault(priority, {"priority": priority, "messages": 0, "bytes": 0, "oldest_s": 0.0})
            total["messages"] += int(number_of(queue.get("messages")) or 0)
            total["bytes"] += int(number_of(queue.get("bytes")) or 0)
            total["oldest_s"] = max(total["oldest_s"], number_of(queue.get("oldest_s")) or 0.0)
    has_queues = any("queues" in peer for peer in peers)
    return {
        "name": name,
        "is_base": name in BASE_NAMES,
        "radios": [name],
        "alarms": [],
        "peers": [
            {key: peer.get(key) if key in ("name", "online") else number_of(peer.get(key)) for key in _PEER_KEYS}
            for peer in peers
        ],
        "queues": [queues[priority] for priority in sorted(queues)] if has_queues or not peers else None,
        "topics": topics,
        "recorded": True,
    }


def joined_by_name(robots: Iterable[RecordedRobot]) -> dict[str, RecordedRobot]:
    """Robots by name; several recordings of one robot, or its places in those of others, become one."""
    found: dict[str, RecordedRobot] = {}
    by_name: dict[str, list[RecordedRobot]] = defaultdict(list)
    for robot in robots:
        by_name[robot.name].append(robot)
    for name, same in by_name.items():
        first = same[0]
        for other in same[1:]:
            first = first.joined(other)
        found[name] = first
    return found


def number_of(value: object) -> float | None:
    # millions of calls for a recording: exact types are cheaper to ask for than isinstance, and leave bool out
    if type(value) is float or type(value) is int:
        return float(value) if -1e15 < value < 1e15 else None
    return None
