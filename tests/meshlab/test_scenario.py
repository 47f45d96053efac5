"""Scenarios: positions over time, the timeline, and the file format."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from meshctl.diagnostics import InvalidInput
from meshctl.placement.ground import NodePosition
from meshctl.placement.path_loss import PathLossModel
from meshlab import scenario_file
from meshlab.propagation import RadioEnvironment, links_of
from meshlab.scenario import (
    Deployment,
    Event,
    EventKind,
    PowerEvent,
    Scenario,
    Trajectory,
    snapshot,
    timeline,
    trajectory,
)

FILE = Path("mission.yaml")
EXAMPLE = Path(__file__).parents[2] / "inventory" / "lab" / "mission.yaml"

# a robot that drives away from the base at 2 m/s with a beacon, which it drops after 100 m
AWAY = Scenario(
    "away",
    "base",
    RadioEnvironment({"base": NodePosition((0, 0), 27.0), "spare": NodePosition((0, 5))}),
    duration_s=200.0,
    robots={"rover": Trajectory((0.0, 200.0), ((0.0, 0.0), (400.0, 0.0)))},
    beacons={"beacon": Deployment("rover", 50.0)},
)
times = st.integers(0, 200).map(float)


def happenings(mission: Scenario, what: EventKind) -> list[tuple[float, str, str]]:
    return [(event.at_s, event.node, event.peer) for event in timeline(mission) if event.kind is what]


@given(times)
def test_a_carried_beacon_is_off_and_a_dropped_one_stays_in_place_powered(t: float) -> None:
    now = snapshot(AWAY, t)
    rover, beacon = now.environment.positions["rover"].at, now.environment.positions["beacon"].at
    assert rover == pytest.approx((2 * t, 0.0))
    assert beacon == (rover if t < 50 else (100.0, 0.0))
    assert ("beacon" in now.powered) == (t >= 50)
    assert now.powered >= {"base", "rover", "spare"}


@given(st.lists(st.tuples(times, st.tuples(times, times)), min_size=1, max_size=5, unique_by=lambda point: point[0]))
def test_a_trajectory_passes_through_its_waypoints_and_is_clamped_at_its_ends(
    points: list[tuple[float, tuple[float, float]]],
) -> None:
    points.sort()
    path = trajectory(points)
    assert all(path.at(at_s) == pytest.approx(place) for at_s, place in points)
    assert path.at(-1.0) == points[0][1]
    assert path.at(1000.0) == points[-1][1]


@pytest.mark.parametrize("way_points", [[], [(1.0, (0.0, 0.0)), (1.0, (1.0, 0.0))]])
def test_a_trajectory_requires_increasing_times(way_points: list[tuple[float, tuple[float, float]]]) -> None:
    with pytest.raises(ValueError, match="increasing times"):
        trajectory(way_points)


def test_the_timeline_has_planned_events_and_their_effects() -> None:
    assert happenings(AWAY, EventKind.ARRIVES) == [(200.0, "rover", "")]
    assert happenings(AWAY, EventKind.DROPPED) == [(50.0, "beacon", "rover")]
    # the dropped beacon joins the mesh, and keeps the robot connected for a while
    assert (50.0, "beacon", "") in happenings(AWAY, EventKind.REACHED)
    ((lost_s, *_),) = happenings(AWAY, EventKind.CUT_OFF)
    alone = replace(
        AWAY, beacons={}, environment=replace(AWAY.environment, positions={"base": NodePosition((0, 0), 27.0)})
    )
    ((lost_alone_s, *_),) = happenings(alone, EventKind.CUT_OFF)
    assert lost_s > lost_alone_s + 40
    assert timeline(AWAY)[-1] == Event(200.0, EventKind.END, "base")


@given(st.sampled_from([0.5, 1.0, 3.0, 7.0]))
def test_events_are_ordered_and_link_events_match_the_environment(step_s: float) -> None:
    mission = replace(AWAY, step_s=step_s)
    events = timeline(mission)
    assert [event.at_s for event in events] == sorted(event.at_s for event in events)
    joined: set[frozenset[str]] = {link.ends for link in links_of(snapshot(mission, 0.0).environment)} - {
        frozenset(("beacon", other)) for other in ("base", "rover", "spare")
    }
    for event in events:
        if event.kind is EventKind.LINK_UP:
            joined.add(frozenset((event.node, event.peer)))
        elif event.kind is EventKind.LINK_DOWN:
            joined.remove(frozenset((event.node, event.peer)))
    end = {link.ends for link in links_of(snapshot(mission, 200.0).environment)}
    assert joined == end


def test_a_power_event_switches_a_node_but_never_powers_a_carried_beacon() -> None:
    mission = replace(
        AWAY,
        power_events=(
            PowerEvent(10.0, "beacon", True),
            PowerEvent(80.0, "beacon", False),
            PowerEvent(90.0, "beacon", True),
        ),
    )
    assert ["beacon" in snapshot(mission, t).powered for t in (9.0, 11.0, 50.0, 80.0, 89.0, 90.0)] == [
        False, False, True, False, False, True,
    ]  # fmt: skip
    assert happenings(mission, EventKind.OFF) == [(80.0, "beacon", "")]


def test_the_order_of_incidents_in_the_file_does_not_matter() -> None:
    late, early = PowerEvent(90.0, "spare", True), PowerEvent(80.0, "spare", False)
    mission = replace(AWAY, power_events=(late, early))
    assert "spare" not in snapshot(mission, 85.0).powered
    assert "spare" in snapshot(mission, 95.0).powered


# -- the file --


def test_a_mission_file_is_parsed(tmp_path: Path) -> None:
    (tmp_path / "ground.yaml").write_text(
        "nodes: {base: [0, 0], spare: [9, 9]}\nair: {exponent: 2}\n", encoding="utf-8"
    )
    text = """
ground: ground.yaml
nodes: {spare: [0, 5]}
duration_s: 200
robots: {rover: {path: [[0, 0, 0], [200, 400, 0]]}}
beacons: {beacon: {carried_by: rover, drop_s: 50}}
incidents: [{at_s: 80, what: "off", who: spare}]
"""
    mission = scenario_file.parse(text, tmp_path / "away.yaml")
    assert (mission.name, mission.base, mission.step_s) == ("away", "base", 1.0)
    assert mission.environment.positions == {"base": NodePosition((0, 0)), "spare": NodePosition((0, 5))}
    assert mission.environment.path_loss == PathLossModel(exponent=2)
    assert (mission.robots, mission.beacons) == (AWAY.robots, AWAY.beacons)
    assert mission.power_events == (PowerEvent(80.0, "spare", False),)
    assert mission.names == ("base", "beacon", "rover", "spare")


GOOD = "nodes: {base: [0, 0]}\nduration_s: 9\nrobots: {r: {path: [[0, 0, 0]]}}\n"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("nodes: {base: [0, 0]}", "mission.yaml:1:1: expected the key duration_s, found no such key"),
        (
            GOOD + "beacons: {b: {carried_by: x, drop_s: 1}}",
            "mission.yaml:4:27: beacons.b.carried_by: expected one of r,",
        ),
        (GOOD + "beacons: {b: {carried_by: r}}", "beacons.b: expected the key drop_s"),
        (GOOD + "beacons: {r: {carried_by: base, drop_s: 1}}", "beacons: expected nodes that are not robots, found r"),
        (GOOD + "incidents: [{at_s: 1, what: explode, who: r}]", "incidents[0].what: expected one of off, on, found"),
        (GOOD + "incidents: [{at_s: 1, what: on, who: x}]", "incidents[0].who: expected one of base, r, found 'x'"),
        (GOOD + "base: x", "mission.yaml:4:7: base: expected one of base, r, found 'x'"),
        (GOOD + "ground: nowhere.yaml", "nowhere.yaml: cannot be read"),
        (GOOD + "step_s: 0", "step_s: expected a number from 0.1"),
        ("duration_s: 9\nnodes: {base: [0, 0]}\nrobots: {r: {path: [[1, 0, 0], [1, 2, 2]]}}", "with increasing times"),
        ("duration_s: 9\nnodes: {base: [0, 0]}\nrobots: {r: {path: [[1, 0]]}}", "path[0]: expected [seconds, x, y]"),
    ],
)
def test_a_parse_error_reports_file_line_expected_and_found(text: str, said: str) -> None:
    with pytest.raises(InvalidInput) as caught:
        scenario_file.parse(text, FILE)
    assert said in str(caught.value)


def test_the_example_drops_every_beacon_in_range_and_ends_with_all_nodes_at_the_base() -> None:
    mission = scenario_file.load(EXAMPLE)
    for name, drop in mission.beacons.items():
        assert (drop.at_s, name, "") in happenings(mission, EventKind.REACHED)
    lost = {name for _, name, _ in happenings(mission, EventKind.CUT_OFF)}
    assert lost == {"rover1", "rover2", "b03"}
    last = {
        event.node: event.kind for event in timeline(mission) if event.kind in (EventKind.CUT_OFF, EventKind.REACHED)
    }
    assert set(last.values()) == {EventKind.REACHED}
