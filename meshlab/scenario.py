"""A mission: robots that drive along way points over a ground and drop the beacons they carry. Values and time alone.

`scene(mission, t)` is the fleet at mission time `t`: the ground with everybody in place, and who has power.
`agenda(mission)` is everything that happens, in order: arrivals, drops, radios that go off and on, links that come and
go, and who loses and regains the base. `mission_file` reads missions, `mission_run` plays them on a fleet.
"""

from __future__ import annotations

import itertools
from bisect import bisect_right
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from types import MappingProxyType

from meshctl.topology import Link, graph_of
from meshlab.propagation import Ground, Place, Point, links_of


@dataclass(frozen=True, slots=True)
class Course:
    """A path over the ground: at `times_s[i]` the robot is at `points[i]`, in between on the straight line."""

    times_s: tuple[float, ...]
    points: tuple[Point, ...]

    def at(self, t: float) -> Point:
        """Before the first time it stands at the first point, after the last at the last."""
        index = bisect_right(self.times_s, t)
        if index == 0:
            return self.points[0]
        if index == len(self.times_s):
            return self.points[-1]
        before, after = self.times_s[index - 1], self.times_s[index]
        share = (t - before) / (after - before)
        (x0, y0), (x1, y1) = self.points[index - 1], self.points[index]
        return (x0 + (x1 - x0) * share, y0 + (y1 - y0) * share)


@dataclass(frozen=True, slots=True)
class Drop:
    """A beacon rides with `by`, without power, until it is dropped and switched on at `at_s`."""

    by: str
    at_s: float


@dataclass(frozen=True, slots=True)
class Incident:
    """A node's radio goes off or on at `at_s`."""

    at_s: float
    who: str
    on: bool


@dataclass(frozen=True, slots=True)
class Mission:
    """`robots` drive, `beacons` are carried and dropped, both by node name; everybody else stands where `ground` says.

    `step_s` is how often the fleet's links follow the robots, in mission time; `base` is where the operator sits.
    """

    name: str
    base: str
    ground: Ground
    duration_s: float
    step_s: float = 1.0
    robots: Mapping[str, Course] = field(default_factory=lambda: MappingProxyType({}))
    beacons: Mapping[str, Drop] = field(default_factory=lambda: MappingProxyType({}))
    incidents: tuple[Incident, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """Every node that takes part, sorted."""
        return tuple(sorted({self.base, *self.ground.names, *self.robots, *self.beacons}))


@dataclass(frozen=True, slots=True)
class Scene:
    """The fleet at one moment: everybody in place, and the nodes that have power."""

    ground: Ground
    powered: frozenset[str]


class Happening(Enum):
    """The value is the word in the output; `Event.other` is the node at the other end, or the beacon's robot."""

    ARRIVES = "arrives"
    DROPPED = "dropped"
    OFF = "off"
    ON = "on"
    LINK_UP = "link-up"
    LINK_DOWN = "link-down"
    CUT_OFF = "cut-off"
    REACHED = "reached"
    END = "end"


@dataclass(frozen=True, slots=True)
class Event:
    """Something that happens to `who` at mission time `at_s`; `place` where that says something."""

    at_s: float
    what: Happening
    who: str
    other: str = ""
    place: Point | None = None


def scene(mission: Mission, t: float) -> Scene:
    """Everybody's place and power at mission time `t`."""
    places = dict(mission.ground.places)

    def put(name: str, at: Point) -> None:
        places[name] = replace(places[name], at=at) if name in places else Place(at)

    for name, course in mission.robots.items():
        put(name, course.at(t))
    for name, drop in mission.beacons.items():
        put(name, _carrier_at(mission, drop, min(t, drop.at_s)))
    off = {name for name, drop in mission.beacons.items() if t < drop.at_s}
    for incident in sorted(mission.incidents, key=lambda one: one.at_s):
        if incident.at_s <= t and incident.on and not _is_carried(mission, incident.who, t):
            off.discard(incident.who)
        elif incident.at_s <= t and not incident.on:
            off.add(incident.who)
    return Scene(replace(mission.ground, places=places), frozenset(mission.names) - off)


def _carrier_at(mission: Mission, drop: Drop, t: float) -> Point:
    course = mission.robots.get(drop.by)
    return course.at(t) if course is not None else mission.ground.places[drop.by].at


def _is_carried(mission: Mission, name: str, t: float) -> bool:
    drop = mission.beacons.get(name)
    return drop is not None and t < drop.at_s


def agenda(mission: Mission) -> tuple[Event, ...]:
    """Everything that happens from 0 to the mission's end, by time; links and reach are looked at every `step_s`."""
    planned = sorted(_planned(mission), key=lambda event: event.at_s)
    events: list[Event] = []
    joined: frozenset[tuple[str, str]] | None = None
    reached: frozenset[str] = frozenset()
    for t in _moments(mission, planned):
        events += [event for event in planned if event.at_s == t]
        now = scene(mission, t)
        pairs = _pairs(now)
        within = graph_of(now.powered, [Link(a, b) for a, b in pairs]).reachable(mission.base)
        if joined is not None:
            events += [Event(t, Happening.LINK_UP, *pair) for pair in sorted(pairs - joined)]
            events += [Event(t, Happening.LINK_DOWN, *pair) for pair in sorted(joined - pairs)]
            events += [Event(t, Happening.REACHED, name) for name in sorted(within - reached)]
            # who has no power is told as off, not as cut off
            events += [Event(t, Happening.CUT_OFF, name) for name in sorted((reached - within) & now.powered)]
        joined, reached = pairs, within
    return (*events, Event(mission.duration_s, Happening.END, mission.base))


def _planned(mission: Mission) -> Iterator[Event]:
    """What the mission's file says will happen, within its duration."""
    for name, course in mission.robots.items():
        for at_s, place in zip(course.times_s, course.points, strict=True):
            if 0 < at_s <= mission.duration_s:
                yield Event(at_s, Happening.ARRIVES, name, place=place)
    for name, drop in mission.beacons.items():
        if 0 < drop.at_s <= mission.duration_s:
            yield Event(drop.at_s, Happening.DROPPED, name, drop.by, _carrier_at(mission, drop, drop.at_s))
    for incident in mission.incidents:
        if 0 < incident.at_s <= mission.duration_s:
            yield Event(incident.at_s, Happening.ON if incident.on else Happening.OFF, incident.who)


def _moments(mission: Mission, planned: Sequence[Event]) -> list[float]:
    """When to look: at every step, and whenever something is planned."""
    count = int(mission.duration_s / mission.step_s)
    steps = (number * mission.step_s for number in range(count + 1))
    return sorted({*steps, *(event.at_s for event in planned), mission.duration_s})


def _pairs(now: Scene) -> frozenset[tuple[str, str]]:
    """Who can talk to whom: both have power and neither is deaf to the other."""
    return frozenset(
        (min(link.ends), max(link.ends))
        for link in links_of(now.ground)
        if link.up and link.ends <= now.powered and max(link.loss_to(link.a), link.loss_to(link.b)) < 1.0
    )


def course(way_points: Sequence[tuple[float, Point]]) -> Course:
    """A course through (seconds, place) pairs; raises ValueError unless there is one and the times rise."""
    times = tuple(time_s for time_s, _ in way_points)
    if not times or any(later <= earlier for earlier, later in itertools.pairwise(times)):
        raise ValueError("way points: expected at least one, with rising times")
    return Course(times, tuple(point for _, point in way_points))
