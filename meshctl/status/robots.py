"""Assess the robots: `RobotAnswers` (all facts) -> `robot_status` -> state, peers, topics and alarms of one robot."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from meshctl.fleet.journal import ROBOT_PREFIX, LastKnown
from meshctl.model import Fleet, NodeState, Robot
from meshctl.robots.facts import RobotFacts
from meshctl.status.robot_alarms import RobotAlarmInput, robot_alarms, urgent_bytes
from meshctl.status.topics import topic_statuses
from meshctl.status.unreachable import NOT_ASKED, no_answer_alarm
from meshctl.status.values import Alarm, Health, Level, NoAnswer, RobotStatus, health_of
from meshctl.topology import Sighting


@dataclass(frozen=True, slots=True)
class RobotAnswers:
    """`facts` of the robots that answered, `no_answer` the reasons of the others; `known` are earlier facts by
    `robot.NAME`; `not_compared` are the `robot.NAME` whose configuration could not be rendered."""

    fleet: Fleet
    facts: Mapping[str, RobotFacts]
    no_answer: Mapping[str, NoAnswer]
    known: Mapping[str, LastKnown]
    now: float
    not_compared: frozenset[str] = frozenset()

    @property
    def base(self) -> str:
        """The operator's own peer; empty if the inventory has none."""
        return next((robot.name for robot in self.fleet.robots.values() if robot.is_base), "")


def robot_state(fleet: Fleet, robot: Robot) -> NodeState | None:
    """DEPLOYED when one of its managed radios is, else the first one's state; None for a robot without radios."""
    states = [fleet.nodes[name].state for name in robot.nodes if name in fleet.nodes]
    if NodeState.DEPLOYED in states:
        return NodeState.DEPLOYED
    return states[0] if states else None


def is_active(state: NodeState | None) -> bool:
    """Whether a robot must answer: deployed, or without radios in this inventory (on another network)."""
    return state in (None, NodeState.DEPLOYED)


def robot_status(answers: RobotAnswers, robot: Robot) -> RobotStatus:
    """One robot's status."""
    state = robot_state(answers.fleet, robot)
    last = answers.known.get(ROBOT_PREFIX + robot.name)
    heard_by = _heard_by(answers, robot.name)
    facts = answers.facts.get(robot.name)
    if facts is None:
        return _unreachable_status(answers, robot, state, last, heard_by)
    topics = topic_statuses(answers.fleet, answers.facts, robot.name) if facts.answers else ()
    waiting = urgent_bytes(answers.fleet, facts)
    found = robot_alarms(RobotAlarmInput(answers.fleet, robot, facts, answers.facts, topics, last, waiting))
    return RobotStatus(
        robot=robot,
        state=state,
        health=health_of(found),
        alarms=found,
        age_s=max(0.0, answers.now - facts.seen_s),
        facts=facts,
        topics=topics,
        is_compared=ROBOT_PREFIX + robot.name not in answers.not_compared,
        urgent_bytes=waiting,
        base_round_trip_s=next((peer.round_trip_s for peer in facts.peers if peer.name == answers.base), None),
        heard_by=heard_by,
    )


def _unreachable_status(
    answers: RobotAnswers, robot: Robot, state: NodeState | None, last: LastKnown | None, heard_by: tuple[Sighting, ...]
) -> RobotStatus:
    why = answers.no_answer.get(robot.name, NOT_ASKED)
    is_required = is_active(state)
    trust = f"meshctl robots trust {robot.name}"
    hint = f"check its address, then run {trust} and meshctl robots deploy {robot.name}"
    alarm = no_answer_alarm(
        why, last, heard_by, answers.now, is_required=is_required, trust=trust, first_contact_hint=hint
    )
    if alarm is not None and heard_by and alarm.code == "unreachable":
        text = f"{alarm.text}: its daemon is heard, but SSH does not answer"
        alarm = Alarm(
            Level.ERROR, "unreachable", text, "check its sshd and its load; the mission can continue without SSH"
        )
    return RobotStatus(
        robot=robot,
        state=state,
        health=Health.UNREACHABLE if is_required else Health.OFF if alarm is None else Health.DEGRADED,
        alarms=() if alarm is None else (alarm,),
        age_s=None if last is None else answers.now - last.seen_s,
        no_answer_reason=why.reason,
        heard_by=heard_by,
        last_known=last.facts if last else None,
    )


def _heard_by(answers: RobotAnswers, robot: str) -> tuple[Sighting, ...]:
    """The robots whose daemons report this one online, latest first."""
    sightings = [
        Sighting(name, round(peer.heard_ago_s * 1000))
        for name, facts in answers.facts.items()
        for peer in facts.peers
        if peer.name == robot and peer.online and peer.heard_ago_s is not None
    ]
    return tuple(sorted(sightings, key=lambda sighting: (sighting.age_ms, sighting.by)))
