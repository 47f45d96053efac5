"""Assess each topic at each robot: the inventory's rate and deadline against the last message sent and received.

Only topics with a rate are assessed. A topic is silent at a source that sends nothing for longer than its limit, and
not arriving at a receiver that hears a sending source but gets nothing. Receivers are not assessed while no source
sends.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping

from meshctl.model import Fleet, Topic, TopicClass
from meshctl.report.duration import duration
from meshctl.robots.facts import RobotFacts, TopicFacts
from meshctl.status.values import TopicStatus

# Missed periods before a topic counts as silent: a single lost message is no alarm.
SILENT_PERIODS = 5
# Robots answer some seconds apart.
MIN_LIMIT_S = 10.0


def is_urgent(topic: Topic) -> bool:
    """Whether the topic is an emergency stop or a command."""
    return topic.topic_class in (TopicClass.EMERGENCY_STOP, TopicClass.COMMAND)


def urgent_priorities(fleet: Fleet) -> frozenset[int]:
    """The priorities of emergency stops and commands; 0 if the inventory has neither."""
    return frozenset(topic.priority for topic in fleet.topics if is_urgent(topic)) or frozenset((0,))


def limit_s(topic: Topic) -> float | None:
    """The longest gap that its rate and deadline allow; None for a topic without a rate."""
    if topic.sent_rate_hz <= 0:
        return None
    return max(SILENT_PERIODS / topic.sent_rate_hz, topic.deadline_s or 0.0, MIN_LIMIT_S)


def topic_statuses(fleet: Fleet, robots: Mapping[str, RobotFacts], robot: str) -> tuple[TopicStatus, ...]:
    """The inventory's topics at this robot by priority, then those that only its daemon knows."""
    facts = robots[robot]
    here = {topic.name: topic for topic in facts.topics}
    wanted = sorted(fleet.topics, key=lambda topic: (topic.priority, topic.name))
    known = [_status(topic, here.get(topic.name), robots, facts) for topic in wanted]
    names = {topic.name for topic in wanted}
    others = [
        TopicStatus(topic.name, topic.priority, topic.sent_ago_s, topic.received_ago_s)
        for topic in facts.topics
        if topic.name not in names
    ]
    return (*known, *others)


def _status(topic: Topic, here: TopicFacts | None, robots: Mapping[str, RobotFacts], facts: RobotFacts) -> TopicStatus:
    limit = limit_s(topic)
    if here is None or here.priority is None:
        return TopicStatus(topic.name, topic.priority, None, None, limit, "is not declared", "undeclared")
    status = TopicStatus(topic.name, here.priority, here.sent_ago_s, here.received_ago_s, limit)
    for code, problem in _problems(topic, here, robots, facts, limit):
        return TopicStatus(topic.name, here.priority, here.sent_ago_s, here.received_ago_s, limit, problem, code)
    return status


def _problems(
    topic: Topic, here: TopicFacts, robots: Mapping[str, RobotFacts], facts: RobotFacts, limit: float | None
) -> Iterator[tuple[str, str]]:
    if here.priority != topic.priority:
        yield "undeclared", f"expected priority {topic.priority}, found {here.priority}"
    if limit is None or (facts.daemon_uptime_s or 0.0) <= limit:
        return
    if _sends(topic, facts.robot):
        silent = _silence_text(here.sent_ago_s, here.sent_messages, limit)
        if silent:
            yield "silent", f"nothing sent {silent}"
    live = [name for name in _live_sources(topic, robots, facts, limit) if name != facts.robot]
    silent = _silence_text(here.received_ago_s, here.received_messages, limit)
    if live and silent and ("all" in topic.destinations or facts.robot in topic.destinations):
        yield "not-arriving", f"nothing received {silent}, although {', '.join(live)} sends"


def _sends(topic: Topic, robot: str) -> bool:
    return not topic.sources or robot in topic.sources


def _silence_text(ago_s: float | None, messages: int, limit: float) -> str:
    """How long there was no message, if too long; empty for a daemon that reports counts but no ages."""
    if ago_s is None:
        return "" if messages else "yet"
    return f"for {duration(ago_s)}" if ago_s > limit else ""


def _live_sources(topic: Topic, robots: Mapping[str, RobotFacts], facts: RobotFacts, limit: float) -> Iterable[str]:
    """The robots heard by this one that currently send the topic."""
    for name in facts.online:
        other = robots.get(name)
        if other is None or not _sends(topic, name):
            continue
        ages = [
            other_topic.sent_ago_s
            for other_topic in other.topics
            if other_topic.name == topic.name and other_topic.sent_ago_s is not None
        ]
        if ages and ages[0] <= limit and _sends_to(topic, facts.robot):
            yield name


def _sends_to(topic: Topic, robot: str) -> bool:
    return "all" in topic.destinations or robot in topic.destinations
