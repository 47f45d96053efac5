"""From what the robots' computers told to their status: state, whom each hears and who hears it, topics, alarms.

`Crew` is all that was told; `robot_status` makes one robot's status of it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from meshctl.fleet.journal import LastKnown
from meshctl.model import Fleet, NodeState, Robot
from meshctl.robots.facts import RobotFacts
from meshctl.status.last_known import ROBOT_PREFIX
from meshctl.status.robot_alarms import RobotSeen, robot_alarms, urgent_bytes
from meshctl.status.topics import topic_statuses
from meshctl.status.unreachable import NOT_ASKED, silent_alarm
from meshctl.status.values import Alarm, Health, Level, RobotStatus, Silence, health_of
from meshctl.topology import Sighting


@dataclass(frozen=True, slots=True)
class Crew:
    """`told` are the facts of every robot that answered, `silent` says why others did not; `known` is what was known
    before, by `robot.NAME`; `not_compared` are the `robot.NAME` whose configuration could not be rendered."""

    fleet: Fleet
    told: Mapping[str, RobotFacts]
    silent: Mapping[str, Silence]
    known: Mapping[str, LastKnown]
    now: float
    not_compared: frozenset[str] = frozenset()

    @property
    def base(self) -> str:
        """The operator's own peer, empty where the inventory has none."""
        return next((robot.name for robot in self.fleet.robots.values() if robot.is_base), "")


def robot_state(fleet: Fleet, robot: Robot) -> NodeState | None:
    """DEPLOYED when one of its managed radios is, else the first one's state; None for a robot without radios."""
    states = [fleet.nodes[name].state for name in robot.nodes if name in fleet.nodes]
    if NodeState.DEPLOYED in states:
        return NodeState.DEPLOYED
    return states[0] if states else None


def takes_part(state: NodeState | None) -> bool:
    """Whether a robot must answer: one on the shelf need not; one without radios here is on some other network."""
    return state in (None, NodeState.DEPLOYED)


def robot_status(crew: Crew, robot: Robot) -> RobotStatus:
    """One robot's status."""
    state = robot_state(crew.fleet, robot)
    last = crew.known.get(ROBOT_PREFIX + robot.name)
    heard_by = _heard_by(crew, robot.name)
    facts = crew.told.get(robot.name)
    if facts is None:
        return _silent(crew, robot, state, last, heard_by)
    topics = topic_statuses(crew.fleet, crew.told, robot.name) if facts.answers else ()
    waiting = urgent_bytes(crew.fleet, facts)
    found = robot_alarms(RobotSeen(crew.fleet, robot, facts, crew.told, topics, last, waiting))
    return RobotStatus(
        robot=robot,
        state=state,
        health=health_of(found),
        alarms=found,
        age_s=max(0.0, crew.now - facts.seen_s),
        facts=facts,
        topics=topics,
        is_compared=ROBOT_PREFIX + robot.name not in crew.not_compared,
        urgent_bytes=waiting,
        base_round_trip_s=next((peer.round_trip_s for peer in facts.peers if peer.name == crew.base), None),
        heard_by=heard_by,
    )


def _silent(
    crew: Crew, robot: Robot, state: NodeState | None, last: LastKnown | None, heard_by: tuple[Sighting, ...]
) -> RobotStatus:
    why = crew.silent.get(robot.name, NOT_ASKED)
    is_missed = takes_part(state)
    trust = f"meshctl robots trust {robot.name}"
    hint = f"is its address right? Then {trust}, and meshctl robots deploy {robot.name}"
    alarm = silent_alarm(why, last, heard_by, crew.now, is_missed=is_missed, trust=trust, take_in=hint)
    if alarm is not None and heard_by and alarm.code == "unreachable":
        told = f"{alarm.text}: its daemon is heard, its SSH is not"
        alarm = Alarm(Level.ERROR, "unreachable", told, "the run may go on without SSH; look at its sshd and its load")
    return RobotStatus(
        robot=robot,
        state=state,
        health=Health.UNREACHABLE if is_missed else Health.OFF if alarm is None else Health.DEGRADED,
        alarms=() if alarm is None else (alarm,),
        age_s=None if last is None else crew.now - last.seen_s,
        silent_because=why.reason,
        heard_by=heard_by,
        last_known=last.facts if last else None,
    )


def _heard_by(crew: Crew, robot: str) -> tuple[Sighting, ...]:
    """The robots whose daemons call this one online, the latest first."""
    seen = [
        Sighting(name, round(peer.heard_ago_s * 1000))
        for name, facts in crew.told.items()
        for peer in facts.peers
        if peer.name == robot and peer.online and peer.heard_ago_s is not None
    ]
    return tuple(sorted(seen, key=lambda one: (one.age_ms, one.by)))
