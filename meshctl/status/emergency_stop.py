"""A real emergency stop, sent from its source to robots, each acknowledging: `send` runs it.

It proves the whole path up to the robots' daemons, with the topic, priority and message of the mission. The robots act
on it, so only the operator may ask for it (`meshctl preflight --send-estop FILE`).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from meshctl.model import Fleet, Topic, TopicClass
from meshctl.robots.host import Host
from meshctl.status.pings import replies

DELIVERED = "delivered"
NOT_SENT = "not sent: its daemon does not answer"
# the script waits 10 s for each outcome, all at once
SEND_TIMEOUT_S = 60.0


@dataclass(frozen=True, slots=True)
class StopPlan:
    """The topic of a stop, its source and its destinations; `silent` are destinations whose daemons do not answer."""

    topic: Topic
    source: str
    destinations: tuple[str, ...]
    silent: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class StopResult:
    """`outcomes`: robot -> `delivered`, or why there was no acknowledgment; `problem`: why nothing was sent."""

    outcomes: Mapping[str, str] = field(default_factory=dict)
    problem: str = ""


def stop_plan(fleet: Fleet, answering: Iterable[str], silent: Iterable[str] = ()) -> StopPlan | None:
    """The first emergency stop of the inventory, from its first source, to its destinations among the active robots.

    It is not sent to destinations in `silent`, whose daemons do not answer, so that no robot stops when its daemon
    starts later; those in `answering` get it. If every robot may send it, the base does. None if the inventory has no
    such topic, or no robot that sends it."""
    names = tuple(answering)
    topic = next((each for each in fleet.topics if each.topic_class is TopicClass.EMERGENCY_STOP), None)
    base = (robot.name for robot in fleet.robots.values() if robot.is_base)
    if topic is None:
        return None
    source = next((name for name in topic.sources or (*base, *names) if name in fleet.robots), None)
    if source is None:
        return None
    wanted = topic.destinations

    def destinations(robots: Iterable[str]) -> tuple[str, ...]:
        return tuple(name for name in robots if name != source and ("all" in wanted or name in wanted))

    return StopPlan(topic, source, destinations(names), destinations(silent))


def send(host: Host, plan: StopPlan, message: bytes) -> StopResult:
    """Send the message from `host`, the source. Raises what `Host.run` raises."""
    words = (plan.topic.name, plan.topic.type_name, *plan.destinations)
    text = host.run("estop", *words, stdin=message, timeout_s=SEND_TIMEOUT_S) if plan.destinations else ""
    found = parse_outcomes(text, plan.destinations)
    return StopResult({**found.outcomes, **dict.fromkeys(plan.silent, NOT_SENT)})


def parse_outcomes(text: str, destinations: Iterable[str]) -> StopResult:
    """The lines of `scripts/estop.sh`; a robot without a line did not acknowledge."""
    found: dict[str, str] = {}
    for peer, reply in replies(text):
        outcome, reason = str(reply.get("outcome", "")), reply.get("reason")
        found[peer] = f"{outcome} ({reason})" if reason and outcome != DELIVERED else outcome
    return StopResult({name: found.get(name) or "no acknowledgment" for name in destinations})
