"""Robots that turn back before they lose a link, in a scenario.

    turn_back:
      husky: {peer: base, bits_per_s: 320e3, priority: 9, reserve_s: 60}

The robot drives along its path as the example of the client decides (`udp_mesh.client.turn_back`): forward, or back the
way it came, at the same speed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from udp_mesh.client.turn_back import Need, decide
from udp_mesh.core.conditions import PeerConditions
from udp_mesh.sim.mobility import Point, Trajectory
from udp_mesh.sim.yaml_entry import Entry
from udp_mesh.wire.limits import PRIORITY_LEVELS

DECISION_S = 1.0
"""Interval of decisions: the daemon's default `conditions_period_s`."""


@dataclass(frozen=True, slots=True)
class TurnBack:
    """A robot's requirements for its link to `peer`."""

    peer: str
    need: Need


def read_turn_back(at: Entry, robots: tuple[str, ...]) -> dict[str, TurnBack]:
    """By robot. `bits_per_s` is needed; the rest has defaults."""
    found = {}
    for robot, entry in at.mapping(robots).items():
        keys = entry.mapping(("peer", "bits_per_s", "priority", "reserve_s"))
        missing = [key for key in ("peer", "bits_per_s") if key not in keys]
        if missing:
            entry.problem(f"the key {missing[0]}")
            continue
        peer = keys["peer"].text(robot, robots)
        if peer == robot:
            keys["peer"].problem("another robot")
        priority = keys["priority"].integer(9, maximum=PRIORITY_LEVELS - 1) if "priority" in keys else 9
        reserve_s = keys["reserve_s"].number(60.0, maximum=3600.0) if "reserve_s" in keys else 60.0
        found[robot] = TurnBack(peer, Need(keys["bits_per_s"].number(100e3, minimum=1.0), priority, reserve_s))
    return found


class DrivenPath:
    """Where a robot with this behavior is: `decide` is called every `DECISION_S`, `at` at any time."""

    def __init__(self, path: Trajectory, behavior: TurnBack) -> None:
        self._path, self._behavior = path, behavior
        self._travelled_s = self._decided_at_s = 0.0
        self.turns_back = False

    def at(self, now: float) -> Point:
        return self._path.at(self._travelled(now))

    def _travelled(self, now: float) -> float:
        """The time of the trajectory at which a robot that only drives forward would be here."""
        passed_s = now - self._decided_at_s
        return max(0.0, self._travelled_s + (-passed_s if self.turns_back else passed_s))

    def decide(self, peers: tuple[PeerConditions, ...], now: float) -> None:
        """Decides from the conditions of the robot's node."""
        self._travelled_s, self._decided_at_s = self._travelled(now), now
        peer = next((candidate for candidate in peers if candidate.name == self._behavior.peer), None)
        shown = None if peer is None else as_shown(peer)
        self.turns_back = decide(shown, self._behavior.need, self.turns_back).turn_back


def as_shown(peer: PeerConditions) -> Mapping[str, Any]:
    """The fields of a peer that `decide` reads, as in the daemon's JSON."""
    trend = peer.trend
    return {
        "online": peer.online,
        "unanswered_for_s": peer.unanswered_for_s,
        "loss": peer.loss,
        "available_bits_per_s": peer.available_bits_per_s,
        "trend": None
        if trend is None
        else {
            "direction": trend.direction.value,
            "measure": trend.measure.value,
            "change_per_s": trend.change_per_s,
        },
    }
