"""A scenario: robots drive along waypoints and deploy the beacons they carry. Pure.

`snapshot(scenario, t)` is the fleet at scenario time `t`: the positions of all nodes, and which nodes have power.
`timeline(scenario)` is the sequence of all events: arrivals, deployments, power changes, links that come and go, nodes
that lose and regain the base. `scenario_file` reads scenarios, `scenario_run` plays them on a fleet.
"""

from __future__ import annotations

import itertools
from bisect import bisect_right
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from types import MappingProxyType

from meshctl.placement.ground import NodePosition
from meshctl.placement.path_loss import Point
from meshctl.topology import Link, graph_of
from meshlab.propagation import RadioEnvironment, links_of


@dataclass(frozen=True, slots=True)
class Trajectory:
    """At `times_s[i]` the robot is at `points[i]`; in between it moves on the straight line."""

    times_s: tuple[float, ...]
    points: tuple[Point, ...]

    def at(self, t: float) -> Point:
        """The position at time `t`: the first point before the first time, the last point after the last."""
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
class Deployment:
    """A beacon moves with `carrier`, without power, until it is deployed and powered on at `at_s`."""

    carrier: str
    at_s: float


@dataclass(frozen=True, slots=True)
class PowerEvent:
    """A node is powered on or off at `at_s`."""

    at_s: float
    node: str
    on: bool


@dataclass(frozen=True, slots=True)
class TrialSettings:
    """Additional settings of `mission_trial`: each robot reports every `report_s`, routes are chosen every `route_s`,
    slow fading has this standard deviation and decorrelates over `shadow_m`."""

    report_s: float = 1.0
    route_s: float = 1.0
    shadow_db: float = 3.0
    shadow_m: float = 10.0


@dataclass(frozen=True, slots=True)
class Scenario:
    """`robots` move and `beacons` are deployed, by node name; the others stay where `environment` has them.

    `step_s` is the interval at which the links follow the robots, in scenario time; the operator is at `base`.
    """

    name: str
    base: str
    environment: RadioEnvironment
    duration_s: float
    step_s: float = 1.0
    robots: Mapping[str, Trajectory] = field(default_factory=lambda: MappingProxyType({}))
    beacons: Mapping[str, Deployment] = field(default_factory=lambda: MappingProxyType({}))
    power_events: tuple[PowerEvent, ...] = ()
    trial: TrialSettings = TrialSettings()

    @property
    def names(self) -> tuple[str, ...]:
        """Every node of the scenario, sorted."""
        return tuple(sorted({self.base, *self.environment.names, *self.robots, *self.beacons}))


@dataclass(frozen=True, slots=True)
class Snapshot:
    """The fleet at one moment: all positions, and the nodes with power."""

    environment: RadioEnvironment
    powered: frozenset[str]


class EventKind(Enum):
    """The value is the name in the output; `Event.peer` is the node at the other end, or the beacon's carrier."""

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
    """An event of `node` at scenario time `at_s`; `position` for arrivals and deployments."""

    at_s: float
    kind: EventKind
    node: str
    peer: str = ""
    position: Point | None = None


def snapshot(scenario: Scenario, t: float) -> Snapshot:
    """The positions and power of all nodes at scenario time `t`."""
    positions = dict(scenario.environment.positions)

    def put(name: str, at: Point) -> None:
        positions[name] = replace(positions[name], at=at) if name in positions else NodePosition(at)

    for name, trajectory in scenario.robots.items():
        put(name, trajectory.at(t))
    for name, deployment in scenario.beacons.items():
        put(name, _carrier_at(scenario, deployment, min(t, deployment.at_s)))
    off = {name for name, drop in scenario.beacons.items() if t < drop.at_s}
    for event in sorted(scenario.power_events, key=lambda power_event: power_event.at_s):
        if event.at_s <= t and event.on and not _is_carried(scenario, event.node, t):
            off.discard(event.node)
        elif event.at_s <= t and not event.on:
            off.add(event.node)
    return Snapshot(replace(scenario.environment, positions=positions), frozenset(scenario.names) - off)


def _carrier_at(scenario: Scenario, deployment: Deployment, t: float) -> Point:
    carrier = scenario.robots.get(deployment.carrier)
    return carrier.at(t) if carrier is not None else scenario.environment.positions[deployment.carrier].at


def _is_carried(scenario: Scenario, name: str, t: float) -> bool:
    deployment = scenario.beacons.get(name)
    return deployment is not None and t < deployment.at_s


def timeline(scenario: Scenario) -> tuple[Event, ...]:
    """All events from 0 to the scenario's end, by time; links and reachability are sampled every `step_s`."""
    planned = sorted(_planned(scenario), key=lambda event: event.at_s)
    events: list[Event] = []
    connected: frozenset[tuple[str, str]] | None = None
    reachable_before: frozenset[str] = frozenset()
    for t in _sample_times(scenario, planned):
        events += [event for event in planned if event.at_s == t]
        now = snapshot(scenario, t)
        pairs = _connected_pairs(now)
        reachable = graph_of(now.powered, [Link(a, b) for a, b in pairs]).reachable(scenario.base)
        if connected is not None:
            events += [Event(t, EventKind.LINK_UP, *pair) for pair in sorted(pairs - connected)]
            events += [Event(t, EventKind.LINK_DOWN, *pair) for pair in sorted(connected - pairs)]
            events += [Event(t, EventKind.REACHED, name) for name in sorted(reachable - reachable_before)]
            # a node without power is off, not cut off
            events += [
                Event(t, EventKind.CUT_OFF, name) for name in sorted((reachable_before - reachable) & now.powered)
            ]
        connected, reachable_before = pairs, reachable
    return (*events, Event(scenario.duration_s, EventKind.END, scenario.base))


def _planned(scenario: Scenario) -> Iterator[Event]:
    """The events that the scenario specifies, within its duration."""
    for name, robot in scenario.robots.items():
        for at_s, place in zip(robot.times_s, robot.points, strict=True):
            if 0 < at_s <= scenario.duration_s:
                yield Event(at_s, EventKind.ARRIVES, name, position=place)
    for name, deployment in scenario.beacons.items():
        if 0 < deployment.at_s <= scenario.duration_s:
            yield Event(
                deployment.at_s,
                EventKind.DROPPED,
                name,
                deployment.carrier,
                _carrier_at(scenario, deployment, deployment.at_s),
            )
    for event in scenario.power_events:
        if 0 < event.at_s <= scenario.duration_s:
            yield Event(event.at_s, EventKind.ON if event.on else EventKind.OFF, event.node)


def _sample_times(scenario: Scenario, planned: Sequence[Event]) -> list[float]:
    """The times to sample: every step, and every planned event."""
    count = int(scenario.duration_s / scenario.step_s)
    steps = (number * scenario.step_s for number in range(count + 1))
    return sorted({*steps, *(event.at_s for event in planned), scenario.duration_s})


def _connected_pairs(now: Snapshot) -> frozenset[tuple[str, str]]:
    """The pairs of nodes that have power and hear each other in both directions."""
    return frozenset(
        (min(link.ends), max(link.ends))
        for link in links_of(now.environment)
        if link.up and link.ends <= now.powered and max(link.loss_to(link.a), link.loss_to(link.b)) < 1.0
    )


def trajectory(waypoints: Sequence[tuple[float, Point]]) -> Trajectory:
    """A trajectory through (seconds, point) pairs. Raises ValueError unless there is one and times increase."""
    times = tuple(time_s for time_s, _ in waypoints)
    if not times or any(later <= earlier for earlier, later in itertools.pairwise(times)):
        raise ValueError("waypoints: expected at least one, with increasing times")
    return Trajectory(times, tuple(point for _, point in waypoints))
