"""The recording of a run: one JSON object per line, written during the run, readable after a crash.

The first line is `{"recording": 1, "node": ..., "started": UNIX_TIME}`; every other line has `t` (seconds since the
start), `kind`, and `at` (the node whose view it is) unless that is the node of the first line. The kinds read here:

- `received`, `sent`: `topic`, `priority`, `bytes`, and for `received` also `source`,
- `message-delivered` (`latency_s`), `message-expired`, `message-peer-lost`: `peer`, `topic`,
- `peer-online`, `peer-offline`: `peer`,
- `conditions`: `peers`, a list of `name`, `online`, `round_trip_s`, `loss`, `received_bits_per_s`,
  `capacity_bits_per_s`, `outbox_messages`, `hops`, `saved_messages` and `saved_bytes` (totals; all but the name are
  optional); optional `versions` (by `topic`:
  `whole_sent`, `differences_sent`, `payload_bytes_sent`, `body_bytes_sent`, totals) and `logs` (by `topic` and
  `source`: `received_items`, `known_items`, `held_bytes`), `thin` (see `thin_links`), and `radio` here and of a peer
  (see `radio_paths`),
- `place`: `x`, `y` in meters (simulated runs),
- `gap`: `lines`, the number of lines dropped here during recording.

Every other kind is an event, with its fields as text.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any, BinaryIO

from udp_mesh.report.fields import UnreadableError, integer, number, rows, text
from udp_mesh.report.radio_paths import RadioSample, radio_problem, radio_sample
from udp_mesh.report.thin_links import ThinLinkSample, ThinPeerSample, thin_items

VERSION = 1
MAX_LINE_BYTES = 128 << 20
"""Maximum line length: the largest usual message (64 MiB) fits, recorded with its payload in base64."""
MAX_T_S = 1e9
"""Thirty years: a later time is damage, and would compress every chart to a point."""
MAX_PLACE_M = 1e7
MAX_SAMPLE = 1e15
_SAMPLED = ("round_trip_s", "loss", "received_bits_per_s", "hops", "outbox_messages", "capacity_bits_per_s")
_VERSION_KEYS = ("whole_sent", "differences_sent", "payload_bytes_sent", "body_bytes_sent")
MAX_EVENT_TEXT = 200


class RecordingError(ValueError):
    """An invalid recording; names file, line, what was expected and what was found."""


@dataclass(frozen=True, slots=True)
class RecordedArrival:
    t: float
    at: str
    source: str
    topic: str
    priority: int
    size: int


@dataclass(frozen=True, slots=True)
class VersionTotals:
    """Versions of a topic with `delta` sent since the daemon's start."""

    whole: int = 0
    differences: int = 0
    payload_bytes: int = 0
    body_bytes: int = 0

    def since(self, earlier: VersionTotals) -> VersionTotals:
        return VersionTotals(
            self.whole - earlier.whole,
            self.differences - earlier.differences,
            self.payload_bytes - earlier.payload_bytes,
            self.body_bytes - earlier.body_bytes,
        )


@dataclass(frozen=True, slots=True)
class LogProgress:
    """A shared log as the node saw it last."""

    received_items: int
    known_items: int
    held_bytes: int


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
    outbox_messages: int | None = None
    capacity_bits_per_s: float | None = None


@dataclass(frozen=True, slots=True)
class Place:
    t: float
    at: str
    x: float
    y: float


@dataclass(frozen=True, slots=True)
class SentMessage:
    t: float
    topic: str
    priority: int
    size: int


@dataclass(frozen=True, slots=True)
class SentOutcome:
    """The outcome of a sent message at one destination; `latency_s` if `kind` is `delivered`."""

    t: float
    peer: str
    topic: str
    kind: str
    latency_s: float | None = None


@dataclass(frozen=True, slots=True)
class SavedTotals:
    """Messages that a peer was not sent because no program there wants them, since the daemon's start."""

    messages: int = 0
    bytes: int = 0


@dataclass(frozen=True, slots=True)
class RecordedEvent:
    t: float
    at: str
    kind: str
    text: str


@dataclass(frozen=True, slots=True)
class Snapshot:
    """A line with conditions; what it says of peers, versions and logs are items of their own, which follow."""

    t: float


@dataclass(frozen=True, slots=True)
class VersionSample:
    topic: str
    totals: VersionTotals


@dataclass(frozen=True, slots=True)
class LogSample:
    topic: str
    source: str
    progress: LogProgress


@dataclass(frozen=True, slots=True)
class SavedSample:
    peer: str
    totals: SavedTotals


@dataclass(frozen=True, slots=True)
class Gap:
    """Lines that were dropped during recording."""

    t: float
    lines: int


@dataclass(frozen=True, slots=True)
class InvalidLine:
    """`text` names file, line, what was expected and what was found."""

    text: str


Item = (
    RecordedArrival
    | SentMessage
    | SentOutcome
    | Presence
    | Sample
    | Place
    | RecordedEvent
    | Snapshot
    | VersionSample
    | LogSample
    | SavedSample
    | ThinLinkSample
    | ThinPeerSample
    | RadioSample
    | Gap
    | InvalidLine
)


def header(name: str, started: float) -> str:
    return json.dumps({"recording": VERSION, "node": name, "started": started})


def line(item: RecordedArrival | Presence | Sample | Place) -> str:
    """Encodes one line, without the line end."""
    match item:
        case RecordedArrival(_, _, source, topic, priority, size):
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


def lines_of(file: BinaryIO) -> Iterator[bytes]:
    """The lines of a file; of a line that is too long only the beginning, which is still too long."""
    while line := file.readline(MAX_LINE_BYTES + 1):
        yield line
        while len(line) > MAX_LINE_BYTES and not line.endswith(b"\n"):
            line = file.readline(MAX_LINE_BYTES + 1)
            if not line:
                return


class RecordingReader:
    """The items of a recording's lines, in order; `name` and `started` (Unix time) are those of its header.

    Raises RecordingError if the lines are no recording. A truncated or invalid line becomes an InvalidLine.
    """

    def __init__(self, lines: Iterable[bytes], file: str) -> None:
        self._file = file
        self._numbered = _objects(lines)
        _, first = next(self._numbered, (1, "nothing"))
        if not isinstance(first, dict) or "recording" not in first:
            found = first if isinstance(first, str) else "another JSON value"
            raise RecordingError(f'{file}:1: expected {{"recording": {VERSION}, ...}}, found {found}')
        if first["recording"] != VERSION:
            raise RecordingError(f"{file}:1: expected version {VERSION}, found {first['recording']!r}")
        started = first.get("started")
        self.name = str(first.get("node", "")).encode(errors="replace").decode()
        self.started = float(started) if isinstance(started, int | float) else 0.0
        # Each peer's last known state: a recording may begin, or have a gap, while peers are online that no event
        # announced.
        self._online: dict[str, bool] = {}
        self._radio_problem = ""

    def __iter__(self) -> Iterator[Item]:
        for line_number, entry in self._numbered:
            try:
                if isinstance(entry, str):
                    raise UnreadableError("one JSON object", entry)
                yield from self._items(entry)
            except UnreadableError as error:
                yield InvalidLine(f"{self._file}:{line_number}: {error}")

    def _items(self, entry: dict[str, Any]) -> Iterator[Item]:
        """The items of one line."""
        t, kind = number(entry, "t", 0.0, MAX_T_S), entry.get("kind")
        at = text(entry, "at") if "at" in entry else self.name
        match kind:
            case "received":
                source, topic = text(entry, "source"), text(entry, "topic")
                yield RecordedArrival(t, at, source, topic, integer(entry, "priority"), integer(entry, "bytes"))
            case "sent":
                yield SentMessage(t, text(entry, "topic"), integer(entry, "priority"), integer(entry, "bytes"))
            case "message-delivered" | "message-expired" | "message-peer-lost":
                latency_s = number(entry, "latency_s", 0.0, MAX_T_S) if kind == "message-delivered" else None
                outcome = kind.removeprefix("message-")
                yield SentOutcome(t, text(entry, "peer"), text(entry, "topic"), outcome, latency_s)
            case "peer-online" | "peer-offline":
                peer = text(entry, "peer")
                self._online[peer] = kind == "peer-online"
                yield Presence(t, at, peer, self._online[peer])
                yield RecordedEvent(t, at, kind, peer)
            case "conditions":
                yield Snapshot(t)
                yield from self._conditions(t, at, entry)
            case "place":
                x, y = (number(entry, key, -MAX_PLACE_M, MAX_PLACE_M) for key in ("x", "y"))
                yield Place(t, at, x, y)
            case "gap":
                yield Gap(t, integer(entry, "lines"))
            case str():
                yield RecordedEvent(t, at, text(entry, "kind"), _fields(entry))
            case _:
                raise UnreadableError("a string as kind", kind)

    def _conditions(self, t: float, at: str, entry: dict[str, Any]) -> Iterator[Item]:
        for peer_entry in rows(entry, "peers"):
            name = text(peer_entry, "name")
            now_online = peer_entry.get("online")
            # An offline peer's values are old ones.
            keys = [key for key in _SAMPLED if peer_entry.get(key) is not None and now_online is not False]
            known: dict[str, Any] = {key: number(peer_entry, key, 0.0, MAX_SAMPLE) for key in keys}
            yield Sample(t, at, name, **known)
            if "saved_messages" in peer_entry:
                counters = (integer(peer_entry, key) for key in ("saved_messages", "saved_bytes"))
                yield SavedSample(name, SavedTotals(*counters))
            if isinstance(now_online, bool) and now_online != self._online.get(name, False):
                self._online[name] = now_online
                yield Presence(t, at, name, now_online)
            # The radio measures its path to an offline peer, too.
            if (sample := radio_sample(t, name, peer_entry.get("radio"))) is not None:
                yield sample
        yield from self._radio(t, at, entry)
        for row in rows(entry, "versions") if "versions" in entry else ():
            counters = (integer(row, key) for key in _VERSION_KEYS)
            yield VersionSample(text(row, "topic"), VersionTotals(*counters))
        for row in rows(entry, "logs") if "logs" in entry else ():
            counters = (integer(row, key) for key in ("received_items", "known_items", "held_bytes"))
            yield LogSample(text(row, "topic"), text(row, "source"), LogProgress(*counters))
        if "thin" in entry:
            yield from thin_items(t, entry["thin"])

    def _radio(self, t: float, at: str, entry: dict[str, Any]) -> Iterator[RecordedEvent]:
        """An event when a radio stops giving new values, and when all give them again."""
        problem = radio_problem(entry.get("radio"))
        if problem != self._radio_problem:
            self._radio_problem = problem
            shown = problem[:MAX_EVENT_TEXT] or "no problem any more"
            yield RecordedEvent(t, at, "radio-problem", shown)


def _objects(lines: Iterable[bytes]) -> Iterator[tuple[int, Any]]:
    """Each non-empty line with its number: an object, or a description of what it is instead."""
    for line_number, raw in enumerate(lines, 1):
        if not raw.strip():
            continue
        if len(raw) > MAX_LINE_BYTES:
            yield line_number, f"a line of more than {MAX_LINE_BYTES} bytes"
            continue
        try:
            entry = json.loads(raw)
        except (ValueError, RecursionError):
            yield line_number, "invalid JSON (a truncated line?)"
            continue
        yield line_number, entry if isinstance(entry, dict) else "another JSON value"


def _fields(entry: dict[str, Any]) -> str:
    """The fields of an event in words; nested values are left out."""
    known = ((key, value) for key, value in entry.items() if key not in ("t", "kind", "at"))
    shown = ", ".join(f"{key} {value}" for key, value in known if isinstance(value, str | int | float))
    return shown[:MAX_EVENT_TEXT].encode(errors="replace").decode()
