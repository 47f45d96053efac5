"""Playing a mission on a running fleet: each step puts everybody in place, each event is told and done when it is due.

`play` takes the clock, the waiting and the fleet as arguments; `stage_of` makes a running fleet such a stage.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from meshlab import placement
from meshlab.fleet import VirtualFleet
from meshlab.propagation import Ground, links_of
from meshlab.scenario import Event, Happening, Mission, agenda, scene

# links follow the robots at most so often in real time: a fast replay takes bigger steps
_LEAST_STEP_S = 0.2
# Mission time without power after which nobody knows a node's radio any more when it is back: an ad-hoc cell of Linux
# forgets within a minute, and a board takes most of that to boot, which a node of the lab does not. Before that its
# neighbours go on with the numbers it had, and are half deaf to it (docs/lab.md).
FORGOTTEN_S = 20.0


class Stage(Protocol):
    """What a mission needs of a fleet."""

    @property
    def names(self) -> tuple[str, ...]:
        """The fleet's nodes."""
        ...

    def stand_on(self, ground: Ground) -> None:
        """From now on who hears whom is as this ground has it."""
        ...

    def switch(self, name: str, on: bool) -> None:
        """A node's power switch; no matter when it is in that position already."""
        ...

    def forget(self, name: str) -> None:
        """Nobody knows the node's radio any more: so long has it been away, as time passes in the mission."""
        ...


@dataclass(frozen=True, slots=True)
class FleetStage:
    """A running fleet as a stage."""

    fleet: VirtualFleet

    @property
    def names(self) -> tuple[str, ...]:
        return self.fleet.spec.names

    def stand_on(self, ground: Ground) -> None:
        placement.stand_on(self.fleet, ground)

    def switch(self, name: str, on: bool) -> None:
        placement.switch(self.fleet, name, on)

    def forget(self, name: str) -> None:
        placement.forget(self.fleet, name)


def play(
    mission: Mission,
    stage: Stage,
    *,
    tell: Callable[[Event], None],
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
    there = frozenset(stage.names)
    events = [event for event in agenda(mission) if event.at_s > start_s]
    off_s = _off_since(mission, start_s)
    now_s = start_s
    try:
        _put(mission, stage, start_s, there)
        links = links_of(scene(mission, start_s).ground)
        begun = clock()
        while events:
            wait(max(_LEAST_STEP_S, mission.step_s / speed))
            # never past the end: the last step puts everybody where the mission leaves them
            now_s = min(mission.duration_s, start_s + (clock() - begun) * speed)
            now = scene(mission, now_s)
            if links_of(now.ground) != links:
                links = links_of(now.ground)
                stage.stand_on(now.ground)
            while events and events[0].at_s <= now_s:
                event = events.pop(0)
                tell(event)
                if event.who in there:
                    _do(event, stage, off_s)
    except KeyboardInterrupt:
        return now_s
    return None


def _off_since(mission: Mission, t: float) -> dict[str, float]:
    """Who has no power at `t`, and since when; whoever is carried has been away since long before."""
    off_s = {name: float("-inf") for name in mission.beacons}
    for event in agenda(mission):
        if event.at_s <= t and event.what is Happening.OFF:
            off_s[event.who] = event.at_s
        elif event.at_s <= t and event.what in (Happening.DROPPED, Happening.ON):
            off_s.pop(event.who, None)
    return off_s


def _put(mission: Mission, stage: Stage, t: float, there: frozenset[str]) -> None:
    """Everybody's place and power as the mission has it at `t`, whatever they were before."""
    now = scene(mission, t)
    stage.stand_on(now.ground)
    for name in mission.names:
        if name in there:
            stage.switch(name, name in now.powered)


def _do(event: Event, stage: Stage, off_s: dict[str, float]) -> None:
    match event.what:
        case Happening.DROPPED | Happening.ON:
            if event.at_s - off_s.pop(event.who, event.at_s) >= FORGOTTEN_S:
                stage.forget(event.who)
            stage.switch(event.who, True)
        case Happening.OFF:
            off_s[event.who] = event.at_s
            stage.switch(event.who, False)
        case _:
            pass
