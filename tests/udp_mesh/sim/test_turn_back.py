"""A robot explores at 1.5 m/s away from its base: with the example behavior it keeps its link, without it loses it."""

from __future__ import annotations

import json
from dataclasses import dataclass, field

import pytest

from udp_mesh.client.turn_back import Need, decide
from udp_mesh.core.events import Event, MessageReceived, PeerOffline
from udp_mesh.core.settings import Settings, Topic
from udp_mesh.daemon.status import conditions_json
from udp_mesh.sim.medium import RadioChannel
from udp_mesh.sim.mobility import PathLoss
from udp_mesh.sim.team import Team

AIR = PathLoss(good_m=60.0, range_m=150.0, least_loss=0.02)
MAP = Topic("map", priority=9)
STEP_S = 0.5
SPEED_M_PER_S = 1.5
MAP_BYTES = 20_000
NEED = Need(bits_per_s=MAP_BYTES * 8 / STEP_S, priority=MAP.priority)


@dataclass
class Mission:
    """What became of it."""

    farthest_m: float = 0.0
    turns: int = 0
    sent: int = 0
    arrived: int = 0
    lost_at_s: list[float] = field(default_factory=list)
    """When the robot was offline for the base."""


def explore(behaves: bool, seed: int, duration_s: float = 400.0) -> Mission:
    """The robot drives away, and back while the behavior says so; it sends a piece of its map every `STEP_S`."""
    mission, x_m, turn_back = Mission(), 5.0, False

    def on_event(now: float, robot: str, event: Event) -> None:
        if robot != "base":
            return
        if isinstance(event, PeerOffline):
            mission.lost_at_s.append(now)
        mission.arrived += isinstance(event, MessageReceived)

    settings = {name: Settings(name, unkeyed=True, topics=(MAP,)) for name in ("base", "husky")}
    team = Team(
        settings,
        channel=RadioChannel(),
        loss=lambda a, b, now: AIR.loss((0.0, 0.0), (x_m, 0.0)),
        seed=seed,
        on_event=on_event,
    )
    for step in range(int(duration_s / STEP_S)):
        team.event_queue.run_until(step * STEP_S)
        if step * STEP_S < 2.0:
            continue
        # as a program gets them from its daemon
        conditions = json.loads(json.dumps(conditions_json(team.conditions("husky"))))
        base = next((peer for peer in conditions["peers"] if peer["name"] == "base"), None)
        decision = decide(base, NEED, turn_back)
        if behaves and decision.turn_back != turn_back:
            turn_back = decision.turn_back
            mission.turns += 1
        x_m = max(5.0, x_m + SPEED_M_PER_S * STEP_S * (-1.0 if turn_back else 1.0))
        mission.farthest_m = max(mission.farthest_m, x_m)
        team.send("husky", MAP.name, bytes(MAP_BYTES), "base")
        mission.sent += 1
    return mission


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_with_the_behavior_the_robot_explores_to_the_edge_and_keeps_its_link(seed: int) -> None:
    mission = explore(behaves=True, seed=seed)
    assert mission.lost_at_s == []
    # far out, but not to where nothing arrives; and out again after it came back
    assert AIR.good_m < mission.farthest_m < AIR.range_m
    assert mission.turns >= 3
    # but for what was just sent
    assert mission.arrived >= mission.sent - 3


@pytest.mark.parametrize("seed", [1, 2])
def test_without_it_the_link_is_lost_for_good(seed: int) -> None:
    mission = explore(behaves=False, seed=seed)
    assert len(mission.lost_at_s) == 1
    assert mission.farthest_m > AIR.range_m
    assert mission.arrived < mission.sent / 2
