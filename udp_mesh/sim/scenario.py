"""A scenario file (YAML) as values: robots and relays, their trajectories, traffic and incidents.

`load(path)` -> YAML nodes with their lines -> checked values -> `Scenario`. Every problem is reported with file and
line, what was expected and what was found; unknown keys are problems.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Literal

import yaml

from udp_mesh.core.settings import MAX_COPIES, Log, Outbox, Settings, Topic
from udp_mesh.sim.medium import RadioChannel
from udp_mesh.sim.mobility import PathLoss, Trajectory, Wall, stationary, trajectory
from udp_mesh.sim.reads import Reads, read_reads
from udp_mesh.sim.thin_scenario import ThinRadios, read_thin
from udp_mesh.sim.turning_back import TurnBack, read_turn_back
from udp_mesh.sim.yaml_entry import Entry

_MAX_SHOWN_PROBLEMS = 20
_MAX_BYTES = 1 << 20
MAX_MESSAGE_BYTES = 1 << 22
"""Maximum size of a simulated message."""
MAX_DURATION_S = 1e7
"""Maximum duration: four months. A longer one is a mistake."""

# Minimum and maximum of each number of `RadioChannel` and `PathLoss`, in its unit.
_RANGES = {
    "rate": (1e3, 1e11),
    "overhead_s": (0.0, 1.0),
    "queue_frames": (1, 1_000_000),
    "attempts": (1, 255),
    "broadcast_repeats": (1, 16),
    "route_s": (0.001, 3600.0),
    "hop_delay_s": (0.0, 10.0),
    "good_m": (0.0, 1e6),
    "range_m": (0.001, 1e6),
    "least_loss": (0.0, 1.0),
}


class ScenarioError(ValueError):
    """An invalid scenario; one line per problem."""


@dataclass(frozen=True, slots=True)
class Flow:
    """Messages of one topic: each of `sources` sends a message of about `size_bytes` to `destination` (empty: all)
    every `period_s`, with a random offset within the first period. `spread` is the sigma of a lognormal size
    distribution with that mean (0: constant size)."""

    topic: str
    sources: tuple[str, ...]
    destination: str
    period_s: float
    size_bytes: int
    spread: float = 0.0
    start_s: float = 0.0
    stop_s: float = float("inf")


@dataclass(frozen=True, slots=True)
class Incident:
    """`what` is `off` or `on` (a robot's or relay's radio), `crash` or `restart` (a robot's process), at `at_s`."""

    at_s: float
    what: str
    who: str


INCIDENTS = ("off", "on", "crash", "restart")


@dataclass(frozen=True, slots=True)
class Scenario:
    """`robots` and `relays` map names to trajectories; a relay may `appear` later (a beacon that is dropped). `reads`:
    what the programs of each robot read (not listed: everything); if any is listed, all send selectively."""

    name: str
    seed: int
    duration_s: float
    robots: Mapping[str, Trajectory]
    relays: Mapping[str, Trajectory]
    appear_s: Mapping[str, float]
    channel: RadioChannel
    air: PathLoss
    topics: tuple[Topic, ...]
    flows: tuple[Flow, ...]
    incidents: tuple[Incident, ...]
    observer: str
    window: Literal["adaptive"] | int
    reads: Reads = field(default_factory=dict)
    thin: ThinRadios = field(default_factory=ThinRadios)
    turn_back: Mapping[str, TurnBack] = field(default_factory=dict)
    """Robots that drive their path back and forth, so that they keep a link."""


def load(path: Path) -> Scenario:
    """Loads a scenario. Raises ScenarioError with every problem found."""
    try:
        raw = path.read_bytes()
    except OSError as error:
        raise ScenarioError(f"{path}: cannot read: {error.strerror}") from error
    return parse(raw, str(path))


def parse(raw: bytes, file: str) -> Scenario:
    """Like `load`, from the file's bytes."""
    if len(raw) > _MAX_BYTES:
        raise ScenarioError(f"{file}: expected at most {_MAX_BYTES} bytes, found {len(raw)}")
    try:
        text = raw.decode()
        for event in yaml.parse(text, Loader=yaml.SafeLoader):
            if isinstance(event, yaml.AliasEvent):
                line = event.start_mark.line + 1 if event.start_mark else 1
                raise ScenarioError(f"{file}:{line}: expected no aliases, found *{event.anchor}")
        root = yaml.compose(text, Loader=yaml.SafeLoader)
    except UnicodeDecodeError as error:
        line = raw.count(b"\n", 0, error.start) + 1
        raise ScenarioError(f"{file}:{line}: expected UTF-8, found byte {raw[error.start]:#04x}") from error
    except (yaml.YAMLError, RecursionError) as error:
        mark = getattr(error, "problem_mark", None)
        line = mark.line + 1 if mark else 1
        found = getattr(error, "problem", None) or str(error).splitlines()[0]
        raise ScenarioError(f"{file}:{line}: expected YAML, found a syntax error: {found}") from error
    problems: list[str] = []
    scenario = _scenario(Entry(root, file, "", problems), Path(file).stem)
    if problems:
        more = [f"... and {len(problems) - _MAX_SHOWN_PROBLEMS} more"] if len(problems) > _MAX_SHOWN_PROBLEMS else []
        raise ScenarioError("\n".join([*problems[:_MAX_SHOWN_PROBLEMS], *more]))
    return scenario


_KEYS = (
    "name", "seed", "duration_s", "observer", "window", "channel", "air", "robots", "relays", "topics", "flows",
    "reads", "incidents", "turn_back", "thin",
)  # fmt: skip


def _scenario(at: Entry, name: str) -> Scenario:
    if at.node is None:
        at.problem("a mapping")
    keys = at.mapping(_KEYS)
    nothing = Entry(None, at.file, "", at.problems)

    def get(key: str) -> Entry:
        return keys.get(key, nothing)

    robot_entries = get("robots").mapping(None)
    robots = {key: _trajectory(value, ()) for key, value in robot_entries.items()}
    for key, value in robot_entries.items():
        try:
            Settings(key, unkeyed=True)
        except ValueError as error:
            value.problem("a valid node name", str(error))
    relay_entries = get("relays").mapping(None)
    relays = {key: _trajectory(value, ("appear_s",)) for key, value in relay_entries.items()}
    appear_s = {}
    for key, value in relay_entries.items():
        if key in robots:
            value.problem("a name that is not a robot's", key)
        if isinstance(value.node, yaml.MappingNode):
            entries = value.mapping(None)
            if "appear_s" in entries:
                appear_s[key] = entries["appear_s"].number(0.0)
    if len(robots) < 2:
        get("robots").problem("at least two robots", len(robots))
    topics = tuple(_topic(key, value, tuple(robots)) for key, value in get("topics").mapping(None).items())
    topic_names = tuple(topic.name for topic in topics)
    window = get("window").text("adaptive")
    return Scenario(
        name=get("name").text(name),
        seed=get("seed").integer(1),
        duration_s=get("duration_s").number(60.0, minimum=1e-3, maximum=MAX_DURATION_S),
        robots=robots,
        relays=relays,
        appear_s=appear_s,
        channel=_channel(get("channel")),
        air=_path_loss(get("air")),
        topics=topics,
        flows=tuple(_flow(item, topic_names, tuple(robots)) for item in get("flows").items()),
        incidents=tuple(_incident(item, tuple(robots), tuple(relays)) for item in get("incidents").items()),
        observer=get("observer").text(next(iter(robots), ""), tuple(robots)),
        reads=read_reads(get("reads"), tuple(robots)),
        window="adaptive" if window == "adaptive" else get("window").integer(3, minimum=1, maximum=4096),
        thin=read_thin(get("thin"), _path_loss),
        turn_back=read_turn_back(get("turn_back"), tuple(robots)),
    )


def _pair(at: Entry) -> tuple[float, float]:
    values = [item.number(0.0, minimum=-1e6, maximum=1e6) for item in at.items()]
    if len(values) != 2:
        at.problem("[x, y] in meters")
        return (0.0, 0.0)
    return (values[0], values[1])


def _trajectory(at: Entry, more: tuple[str, ...]) -> Trajectory:
    """`[x, y]`, or `{at: [x, y]}`, or `{path: [[seconds, x, y], ...]}`."""
    if isinstance(at.node, yaml.SequenceNode):
        return stationary(_pair(at))
    entries = at.mapping(("at", "path", *more))
    if "at" in entries:
        return stationary(_pair(entries["at"]))
    points = []
    for item in entries["path"].items() if "path" in entries else ():
        values = [value.number(0.0, minimum=-1e6, maximum=1e6) for value in item.items()]
        if len(values) == 3:
            points.append((values[0], (values[1], values[2])))
        else:
            item.problem("[seconds, x, y]")
    try:
        return trajectory(points)
    except ValueError:
        at.problem("`at: [x, y]` or `path: [[seconds, x, y], ...]` with increasing times")
        return stationary((0.0, 0.0))


def _numbers(at: Entry, made: Any) -> dict[str, Any]:
    known = tuple(item.name for item in fields(made) if item.name != "walls")
    entries = at.mapping((*known, "walls") if isinstance(made, PathLoss) else known)
    values: dict[str, Any] = {}
    for name in known:
        if name in entries:
            default = getattr(made, name)
            if isinstance(default, bool):
                values[name] = entries[name].flag()
                continue
            minimum, maximum = _RANGES[name]
            if isinstance(default, int):
                values[name] = entries[name].integer(default, int(minimum), int(maximum))
            else:
                values[name] = entries[name].number(default, minimum, maximum)
    return values


def _channel(at: Entry) -> RadioChannel:
    return RadioChannel(**_numbers(at, RadioChannel()))


def _path_loss(at: Entry) -> PathLoss:
    walls = []
    entries = at.mapping(None)
    for item in entries["walls"].items() if "walls" in entries else ():
        parts = item.mapping(("a", "b", "loss"))
        if "a" in parts and "b" in parts:
            loss = parts["loss"].number(1.0, maximum=1.0) if "loss" in parts else 1.0
            walls.append(Wall(_pair(parts["a"]), _pair(parts["b"]), loss))
        else:
            item.problem("a and b, each [x, y]")
    air = PathLoss(**_numbers(at, PathLoss()), walls=tuple(walls))
    if air.range_m < air.good_m:
        at.problem(f"range_m of at least good_m, {air.good_m:g}", air.range_m)
    return air


def _topic(name: str, at: Entry, robots: tuple[str, ...]) -> Topic:
    keys = (
        "priority", "reliable", "keep_last", "deadline_s", "rate_limit_bytes_per_s", "compression", "destinations",
        "outbox", "repair", "log", "delta", "delta_bytes", "always", "thin", "links", "thin_period_s",
    )  # fmt: skip
    entries = at.mapping(keys)
    values: dict[str, Any] = {}
    for key, entry in entries.items():
        match key:
            case "reliable" | "compression" | "repair" | "delta" | "always" | "thin":
                values[key] = entry.flag()
            case "deadline_s" | "thin_period_s":
                values[key] = entry.number(1.0, minimum=1e-3)
            case "outbox":
                values[key] = Outbox(entry.text("none", tuple(kind.value for kind in Outbox)))
            case "destinations":
                values[key] = tuple(item.text(one_of=robots) for item in entry.items())
            case "links":
                values[key] = tuple(item.text() for item in entry.items())
            case "log":
                values[key] = _log(entry, robots)
            case "priority":
                values[key] = entry.integer(8, maximum=15)
            case _:
                values[key] = entry.integer(1, minimum=1)
    try:
        return Topic(name, **values)
    except ValueError as error:
        at.problem("a valid topic", str(error))
        return Topic("unusable")


def _log(at: Entry, robots: tuple[str, ...]) -> Log:
    entries = at.mapping(("readers", "max_items", "max_bytes", "max_age_s", "copies"))
    values: dict[str, Any] = {}
    for key, entry in entries.items():
        match key:
            case "readers":
                values[key] = tuple(item.text(one_of=robots) for item in entry.items())
            case "max_age_s":
                values[key] = entry.number(1.0, minimum=1e-3)
            case "copies":
                values[key] = entry.integer(3, maximum=MAX_COPIES)
            case _:
                values[key] = entry.integer(1, minimum=1)
    return Log(**values)


def _flow(at: Entry, topics: tuple[str, ...], robots: tuple[str, ...]) -> Flow:
    keys = ("topic", "sources", "destination", "period_s", "size_bytes", "spread", "start_s", "stop_s")
    entries = at.mapping(keys)
    nothing = Entry(None, at.file, at.what, at.problems)

    def get(key: str) -> Entry:
        return entries.get(key, nothing)

    for key in ("topic", "period_s", "size_bytes"):
        if at.node is not None and key not in entries:
            at.problem(f"the key {key}", "none")
    sources = tuple(item.text(one_of=robots) for item in get("sources").items()) or robots
    return Flow(
        topic=get("topic").text("", topics),
        sources=sources,
        destination=get("destination").text("", robots),
        period_s=get("period_s").number(1.0, minimum=1e-3),
        size_bytes=get("size_bytes").integer(1, minimum=1, maximum=MAX_MESSAGE_BYTES),
        spread=get("spread").number(0.0, maximum=5.0),
        start_s=get("start_s").number(0.0),
        stop_s=get("stop_s").number(math.inf),
    )


def _incident(at: Entry, robots: tuple[str, ...], relays: tuple[str, ...]) -> Incident:
    entries = at.mapping(("at_s", "what", "who"))
    for key in ("at_s", "what", "who"):
        if key not in entries:
            at.problem(f"the key {key}", "none")
            return Incident(0.0, "off", "")
    what = entries["what"].text("off", INCIDENTS)
    # A relay has a radio but no process of ours.
    who = entries["who"].text("", robots if what in ("crash", "restart") else (*robots, *relays))
    return Incident(entries["at_s"].number(0.0), what, who)
