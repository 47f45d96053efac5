"""Play a scenario in virtual time on a target that records all calls."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from meshlab.propagation import RadioEnvironment, links_of
from meshlab.scenario import Event, EventKind, PowerEvent, snapshot, timeline
from meshlab.scenario_run import STATION_EXPIRY_S, play
from tests.meshlab.test_scenario import AWAY


@dataclass
class RecordedTarget:
    """A fleet with these names, and a clock that `wait` advances and that interrupts at `stop_at_s`."""

    names: tuple[str, ...] = AWAY.names
    stop_at_s: float = float("inf")
    now_s: float = 1000.0
    environments: list[RadioEnvironment] = field(default_factory=list)
    powered: dict[str, bool] = field(default_factory=dict)
    switched: list[tuple[str, bool]] = field(default_factory=list)
    forgotten: list[str] = field(default_factory=list)
    events: list[Event] = field(default_factory=list)

    def set_environment(self, environment: RadioEnvironment) -> None:
        self.environments.append(environment)

    def set_power(self, name: str, on: bool) -> None:
        assert name in self.names
        self.powered[name] = on
        self.switched.append((name, on))

    def flush_stations(self, name: str) -> None:
        assert not self.powered[name]
        self.forgotten.append(name)

    def clock(self) -> float:
        return self.now_s

    def wait(self, seconds: float) -> None:
        self.now_s += seconds
        if self.now_s - 1000.0 >= self.stop_at_s:
            raise KeyboardInterrupt


def played(stage: RecordedTarget, *, speed: float = 1.0, start_s: float = 0.0) -> float | None:
    return play(
        AWAY, stage, on_event=stage.events.append, clock=stage.clock, wait=stage.wait, speed=speed, start_s=start_s
    )


@given(st.sampled_from([0.5, 1.0, 10.0, 1000.0]))
def test_every_event_is_reported_once_in_order_however_fast(speed: float) -> None:
    stage = RecordedTarget()
    assert played(stage, speed=speed) is None
    assert stage.events == list(timeline(AWAY))
    assert stage.powered == {"base": True, "beacon": True, "rover": True, "spare": True}
    assert links_of(stage.environments[-1]) == links_of(snapshot(AWAY, AWAY.duration_s).environment)


def test_carried_beacons_are_off_until_they_are_dropped() -> None:
    stage = RecordedTarget()
    played(stage)
    assert [on for name, on in stage.switched if name == "beacon"] == [False, True]


def test_the_fleet_gets_only_changed_links() -> None:
    stage = RecordedTarget()
    played(stage)
    link_sets = [links_of(ground) for ground in stage.environments]
    assert all(one != other for one, other in pairwise(link_sets))
    assert len(link_sets) < AWAY.duration_s


@given(st.integers(1, 199))
def test_a_stopped_and_resumed_mission_reports_the_same_events(stop_at_s: int) -> None:
    first = RecordedTarget(stop_at_s=stop_at_s)
    stopped_s = played(first)
    assert stopped_s is not None
    assert stopped_s <= stop_at_s
    second = RecordedTarget()
    assert played(second, start_s=stopped_s) is None
    assert first.events + second.events == list(timeline(AWAY))
    assert (second.switched[0][0], dict(second.switched[:4])["beacon"]) == ("base", stopped_s >= 50)


@pytest.mark.parametrize(
    ("on_s", "is_forgotten"), [(80.0 + STATION_EXPIRY_S - 1, False), (80.0 + STATION_EXPIRY_S, True)]
)
@pytest.mark.parametrize("start_s", [0.0, 85.0])
def test_station_entries_are_flushed_after_a_node_was_off_past_expiry(
    on_s: float, start_s: float, is_forgotten: bool
) -> None:
    stage = RecordedTarget()
    mission = replace(AWAY, power_events=(PowerEvent(80.0, "spare", False), PowerEvent(on_s, "spare", True)))
    play(mission, stage, on_event=stage.events.append, clock=stage.clock, wait=stage.wait, start_s=start_s)
    assert ("spare" in stage.forgotten) == is_forgotten
    assert ("beacon" in stage.forgotten) == (start_s < 50)


def test_events_of_nodes_outside_the_fleet_are_reported_but_not_applied() -> None:
    stage = RecordedTarget(names=("base", "rover"))
    played(stage)
    assert set(stage.powered) == {"base", "rover"}
    assert EventKind.DROPPED in {event.kind for event in stage.events}


@pytest.mark.parametrize("speed", [1.0, 50.0])
def test_power_events_switch_nodes_off_and_on(speed: float) -> None:
    stage = RecordedTarget()
    mission = replace(AWAY, power_events=(PowerEvent(80.0, "spare", False), PowerEvent(90.0, "spare", True)))
    play(mission, stage, on_event=stage.events.append, clock=stage.clock, wait=stage.wait, speed=speed)
    assert [on for name, on in stage.switched if name == "spare"] == [True, False, True]
