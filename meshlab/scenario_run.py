"""Play a scenario on a running fleet: each step updates the links, each event is reported and applied when it is due.

`play` takes the clock, the wait function and the target as arguments; `FleetTarget` is a running fleet as the target.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from meshlab import placement
from meshlab.fleet import VirtualFleet
from meshlab.propagation import RadioEnvironment, links_of
from meshlab.scenario import Event, EventKind, Scenario, snapshot, timeline

# the shortest step in real time: a fast replay takes longer steps in scenario time
_MIN_STEP_S = 0.2
# Scenario time without power after which a node's neighbors have dropped its station entries when it is back. Linux
# drops an ad-hoc station within a minute, most of which a real board takes to boot; a node of the lab boots in seconds.
# After a shorter time, neighbors keep the old sequence numbers and drop its unicast frames (docs/lab.md).
STATION_EXPIRY_S = 20.0


class ScenarioTarget(Protocol):
    """The interface that a scenario needs from a fleet."""

    @property
    def names(self) -> tuple[str, ...]:
        """The fleet's nodes."""
        ...

    def set_environment(self, environment: RadioEnvironment) -> None:
        """Replace the fleet's links by those of `environment`."""
        ...

    def set_power(self, name: str, on: bool) -> None:
        """Power a node on or off; does nothing when it is already."""
        ...

    def flush_stations(self, name: str) -> None:
        """Delete the node's station entries on all other nodes: it was off for longer than these last."""
        ...


@dataclass(frozen=True, slots=True)
class FleetTarget:
    """A running fleet as the target."""

    fleet: VirtualFleet

    @property
    def names(self) -> tuple[str, ...]:
        return self.fleet.spec.names

    def set_environment(self, environment: RadioEnvironment) -> None:
        placement.set_environment(self.fleet, environment)

    def set_power(self, name: str, on: bool) -> None:
        placement.set_power(self.fleet, name, on)

    def flush_stations(self, name: str) -> None:
        placement.flush_stations(self.fleet, name)


def play(
    scenario: Scenario,
    target: ScenarioTarget,
    *,
    on_event: Callable[[Event], None],
    clock: Callable[[], float],
    wait: Callable[[float], None],
    speed: float = 1.0,
    start_s: float = 0.0,
) -> float | None:
    """Play the scenario from `start_s` on at `speed` times the speed of `clock`; nodes outside the fleet are skipped.

    At the start all nodes are placed, and carried beacons are powered off. `on_event` gets every later event in order.
    Returns None at the scenario's end. A KeyboardInterrupt stops it: the fleet stays as it is, and the scenario time
    is returned, from which it can be continued.
    """
    present = frozenset(target.names)
    events = [event for event in timeline(scenario) if event.at_s > start_s]
    off_s = _off_since(scenario, start_s)
    now_s = start_s
    try:
        _apply_snapshot(scenario, target, start_s, present)
        links = links_of(snapshot(scenario, start_s).environment)
        started = clock()
        while events:
            wait(max(_MIN_STEP_S, scenario.step_s / speed))
            # never past the end: the last step applies the final positions
            now_s = min(scenario.duration_s, start_s + (clock() - started) * speed)
            now = snapshot(scenario, now_s)
            if links_of(now.environment) != links:
                links = links_of(now.environment)
                target.set_environment(now.environment)
            while events and events[0].at_s <= now_s:
                event = events.pop(0)
                on_event(event)
                if event.node in present:
                    _apply_event(event, target, off_s)
    except KeyboardInterrupt:
        return now_s
    return None


def _off_since(scenario: Scenario, t: float) -> dict[str, float]:
    """The nodes without power at `t`, and since when; a carried beacon has been off since before the start."""
    off_s = {name: float("-inf") for name in scenario.beacons}
    for event in timeline(scenario):
        if event.at_s <= t and event.kind is EventKind.OFF:
            off_s[event.node] = event.at_s
        elif event.at_s <= t and event.kind in (EventKind.DROPPED, EventKind.ON):
            off_s.pop(event.node, None)
    return off_s


def _apply_snapshot(scenario: Scenario, target: ScenarioTarget, t: float, present: frozenset[str]) -> None:
    """Apply all positions and power states at `t`, whatever they were before."""
    now = snapshot(scenario, t)
    target.set_environment(now.environment)
    for name in scenario.names:
        if name in present:
            target.set_power(name, name in now.powered)


def _apply_event(event: Event, target: ScenarioTarget, off_s: dict[str, float]) -> None:
    match event.kind:
        case EventKind.DROPPED | EventKind.ON:
            if event.at_s - off_s.pop(event.node, event.at_s) >= STATION_EXPIRY_S:
                target.flush_stations(event.node)
            target.set_power(event.node, True)
        case EventKind.OFF:
            off_s[event.node] = event.at_s
            target.set_power(event.node, False)
        case _:
            pass
