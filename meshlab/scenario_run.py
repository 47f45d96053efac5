"""Playing a mission on a running fleet: each step puts everybody in place, each event is told and done when it is due.

`play` takes the clock, the waiting and the fleet as arguments; `stage_of` makes a running fleet such a stage.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from meshlab import placement
from meshlab.fleet import VirtualFleet
from meshlab.propagation import RadioEnvironment, links_of
from meshlab.scenario import Event, EventKind, Scenario, snapshot, timeline

# links follow the robots at most so often in real time: a fast replay takes bigger steps
_MIN_STEP_S = 0.2
# Mission time without power after which nobody knows a node's radio any more when it is back: an ad-hoc cell of Linux
# forgets within a minute, and a board takes most of that to boot, which a node of the lab does not. Before that its
# neighbours go on with the numbers it had, and are half deaf to it (docs/lab.md).
STATION_EXPIRY_S = 20.0


class ScenarioTarget(Protocol):
    """What a mission needs of a fleet."""

    @property
    def names(self) -> tuple[str, ...]:
        """The fleet's nodes."""
        ...

    def set_environment(self, environment: RadioEnvironment) -> None:
        """From now on who hears whom is as this ground has it."""
        ...

    def set_power(self, name: str, on: bool) -> None:
        """A node's power switch; no matter when it is in that position already."""
        ...

    def flush_stations(self, name: str) -> None:
        """Nobody knows the node's radio any more: so long has it been away, as time passes in the mission."""
        ...


@dataclass(frozen=True, slots=True)
class FleetTarget:
    """A running fleet as a stage."""

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
    """Play the mission from `start_s` on, `speed` times as fast as `clock` goes; nodes the fleet has not do nothing.

    At the start everybody is put in place, and carried beacons are switched off. `tell` gets every event from there on,
    in order. Returns None at the mission's end; when a KeyboardInterrupt came, the mission time at which it stopped:
    everything then stays as it is, and can be taken up from there.
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
            # never past the end: the last step puts everybody where the mission leaves them
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
    """Who has no power at `t`, and since when; whoever is carried has been away since long before."""
    off_s = {name: float("-inf") for name in scenario.beacons}
    for event in timeline(scenario):
        if event.at_s <= t and event.kind is EventKind.OFF:
            off_s[event.node] = event.at_s
        elif event.at_s <= t and event.kind in (EventKind.DROPPED, EventKind.ON):
            off_s.pop(event.node, None)
    return off_s


def _apply_snapshot(scenario: Scenario, target: ScenarioTarget, t: float, present: frozenset[str]) -> None:
    """Everybody's place and power as the mission has it at `t`, whatever they were before."""
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
