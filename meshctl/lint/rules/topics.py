"""Topics: priorities, destinations (MC701 to MC711)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from meshctl.diagnostics import Severity
from meshctl.lint.context import LintContext
from meshctl.lint.grouping import group_by_key
from meshctl.lint.rule import Finding, fleet_rule
from meshctl.lint.rules.references import suggest
from meshctl.model import Fleet, Topic, TopicClass
from meshctl.wording import join_limited

_ALL = "all"
# large, and can wait
_BULK = (TopicClass.MAP, TopicClass.VIDEO)
# a person or a robot waits for these
_URGENT = (TopicClass.EMERGENCY_STOP, TopicClass.COMMAND)
# most urgent first
_ORDER = (
    TopicClass.EMERGENCY_STOP,
    TopicClass.COMMAND,
    TopicClass.ARTIFACT,
    TopicClass.TELEMETRY,
    TopicClass.MAP,
    TopicClass.VIDEO,
)


def _path(topic: Topic, *key: str) -> tuple[str, ...]:
    return ("topics", topic.name, *key)


@fleet_rule(
    "MC701",
    Severity.ERROR,
    "A topic is as urgent as the emergency stop",
    why="""udp_mesh sends in strict priority order, and round-robin within a level: a topic at the emergency stop's
    level or above is sent before it.""",
    fix="Give the emergency stop its own level, 0, and every other topic a larger number.",
    failing="topics: {commands: {priority: 0}}",
    passing="topics: {commands: {priority: 1}}",
)
def stop_not_first(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    stops = [topic for topic in fleet.topics if topic.topic_class is TopicClass.EMERGENCY_STOP]
    others = [topic for topic in fleet.topics if topic.topic_class is not TopicClass.EMERGENCY_STOP]
    for stop in stops:
        before = [topic for topic in others if topic.priority <= stop.priority]
        if before and stop.priority > 0:
            message = f"{join_limited([topic.name for topic in before])} can delay it"
            yield Finding(_path(stop, "priority"), message, "0, which no other topic has", str(stop.priority))
        for topic in before if stop.priority == 0 else ():
            message = f"can delay {stop.name}"
            yield Finding(_path(topic, "priority"), message, f"more than {stop.priority}", str(topic.priority))


@fleet_rule(
    "MC702",
    Severity.ERROR,
    "Bulk data is as urgent as commands",
    why="""Maps and video use all available airtime. At the level of commands or above, they delay the supervisor's
    commands.""",
    fix="Give maps and video larger numbers than every command.",
    failing="topics: {video: {priority: 1}}",
    passing="topics: {video: {priority: 9}}",
)
def bulk_above_commands(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    commands = [topic for topic in fleet.topics if topic.topic_class is TopicClass.COMMAND]
    stops = [topic.priority for topic in fleet.topics if topic.topic_class is TopicClass.EMERGENCY_STOP]
    if not commands:
        return
    last = max(commands, key=lambda topic: topic.priority)
    for topic in fleet.topics:
        # MC701 covers the level of the stop
        if topic.topic_class in _BULK and topic.priority <= last.priority and topic.priority > max(stops, default=-1):
            message = f"can delay {last.name}"
            yield Finding(_path(topic, "priority"), message, f"more than {last.priority}", str(topic.priority))


@fleet_rule(
    "MC703",
    Severity.WARNING,
    "Topics of different classes share a priority",
    why="""Topics of one level are sent round-robin: a large map message delays a telemetry message by as many fragments
    as it has.""",
    fix="Give each class its own level; there are sixteen.",
    failing="topics: {telemetry: {priority: 3}}",
    passing="topics: {telemetry: {priority: 4}}",
)
def classes_tie(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for level, topics in group_by_key((topic.priority, topic) for topic in fleet.topics).items():
        classes = dict.fromkeys(topic.topic_class for topic in topics if topic.topic_class is not TopicClass.OTHER)
        if len(classes) > 1 and not any(topic.topic_class in _URGENT for topic in topics):
            later = next(topic for topic in topics if topic.topic_class is not topics[0].topic_class)
            found = f"{level} for {join_limited([topic.name for topic in topics])}"
            yield Finding(_path(later, "priority"), f"shares the level of {topics[0].name}", "a separate level", found)


@fleet_rule(
    "MC704",
    Severity.WARNING,
    "A class is more urgent than one that should precede it",
    why="""Artifact reports decide the score; telemetry repeats within a second, and a map message can wait a minute. A
    reversed order is usually a typo.""",
    fix="Order the levels: emergency stop, command, artifact, telemetry, map, video.",
    failing="topics: {telemetry: {priority: 10}}",
    passing="topics: {telemetry: {priority: 4}}",
)
def order_turned(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    # MC701 and MC702 cover urgent classes against bulk
    commands = max((t.priority for t in fleet.topics if t.topic_class is TopicClass.COMMAND), default=-1)
    ranked = [
        topic
        for topic in fleet.topics
        if topic.topic_class in _ORDER[1:] and not (topic.topic_class in _BULK and topic.priority <= commands)
    ]
    ranked.sort(key=lambda topic: (_ORDER.index(topic.topic_class), topic.priority))
    # one topic at the wrong level turns its order with all others: the one with most of them is reported
    while ranked:
        topic = max(reversed(ranked), key=lambda each: len(_turned(each, ranked)))
        others = _turned(topic, ranked)
        if not others:
            return
        ranked.remove(topic)
        is_early = topic.priority < others[0].priority
        other = (max if is_early else min)(others, key=lambda each: each.priority)
        word, expected = ("precedes", "more than") if is_early else ("follows", "less than")
        message = f"{topic.topic_class.value} {word} {other.name} ({other.topic_class.value})"
        yield Finding(_path(topic, "priority"), message, f"{expected} {other.priority}", str(topic.priority))


def _turned(topic: Topic, others: Iterable[Topic]) -> list[Topic]:
    """Those before or after which `topic` comes, although its class should not."""
    rank = _ORDER.index(topic.topic_class)
    return [
        other for other in others if (rank - _ORDER.index(other.topic_class)) * (topic.priority - other.priority) < 0
    ]


@fleet_rule(
    "MC705",
    Severity.WARNING,
    "There is no emergency stop topic",
    why="No topic stops the robots. If the stop uses another path, say so in a suppression.",
    fix="Add a topic with `class: emergency_stop` and priority 0.",
    failing="topics: {estop: {class: other}}",
    passing="topics: {estop: {class: emergency_stop}}",
)
def no_emergency_stop(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    if fleet.topics and not any(topic.topic_class is TopicClass.EMERGENCY_STOP for topic in fleet.topics):
        yield Finding(("topics",), "no topic stops the robots", "one of class emergency_stop", "none")


@fleet_rule(
    "MC706",
    Severity.ERROR,
    "The emergency stop is best effort",
    why="A lost datagram is not retransmitted: a robot can miss the stop.",
    fix="Set `reliable: true`.",
    failing="topics: {estop: {reliable: false}}",
    passing="topics: {estop: {reliable: true}}",
)
def stop_best_effort(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for topic in fleet.topics:
        if topic.topic_class is TopicClass.EMERGENCY_STOP and not topic.reliable:
            yield Finding(_path(topic, "reliable"), "may be lost", "true", "false")


@fleet_rule(
    "MC707",
    Severity.ERROR,
    "The emergency stop does not reach every robot",
    why="A robot that is missing from `destinations` does not stop with the others.",
    fix="Set `destinations: [all]`.",
    failing="topics: {estop: {sources: [base-station, husky1], destinations: [base-station]}}",
    passing="topics: {estop: {destinations: [all]}}",
)
def stop_not_for_all(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for topic in fleet.topics:
        if topic.topic_class is not TopicClass.EMERGENCY_STOP or _ALL in topic.destinations:
            continue
        missing = [name for name, robot in fleet.robots.items() if not robot.is_base and name not in topic.destinations]
        if missing:
            yield Finding(
                _path(topic, "destinations"),
                f"{join_limited(missing)} would not stop",
                "all",
                join_limited(topic.destinations),
            )


@fleet_rule(
    "MC708",
    Severity.ERROR,
    "The emergency stop has a rate limit or a deadline",
    why="A rate limit or a deadline drops exactly the stop that was pressed twice, or that a bad link delayed.",
    fix="Remove `rate_limit_bytes_per_s` and `deadline_s` from the emergency stop.",
    failing="topics: {estop: {deadline_s: 1}}",
    passing="topics: {estop: {keep_last: 1}}",
)
def stop_held_back(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for topic in fleet.topics:
        if topic.topic_class is not TopicClass.EMERGENCY_STOP:
            continue
        if topic.deadline_s is not None:
            yield Finding(_path(topic, "deadline_s"), "a late stop is dropped", "none", f"{topic.deadline_s:g} s")
        if topic.rate_limit_bytes_per_s is not None:
            found = f"{topic.rate_limit_bytes_per_s} bytes/s"
            yield Finding(_path(topic, "rate_limit_bytes_per_s"), "a repeated stop is delayed", "none", found)


@fleet_rule(
    "MC709",
    Severity.ERROR,
    "A destination does not exist",
    why="Messages for an unknown peer wait until they expire and are never delivered.",
    fix="Use a robot defined in `robots`, or `all`.",
    failing="topics: {commands: {destinations: [husky1, huskey2]}}",
    passing="topics: {commands: {destinations: [husky1]}}",
)
def destination_unknown(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for topic in fleet.topics:
        for index, name in enumerate(topic.destinations):
            if name != _ALL and name not in fleet.robots:
                expected, hint = suggest((*fleet.robots, _ALL), name)
                yield Finding(_path(topic, "destinations", str(index)), "no such robot", expected, name, hint)


@fleet_rule(
    "MC710",
    Severity.ERROR,
    "A source does not exist",
    why="The topic is bridged on no robot: nothing is ever sent, and no error is reported.",
    fix="Use a robot defined in `robots`, or omit `sources` for all robots.",
    failing="topics: {commands: {sources: [base]}}",
    passing="topics: {commands: {sources: [base-station]}}",
)
def source_unknown(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for topic in fleet.topics:
        for index, name in enumerate(topic.sources):
            if name not in fleet.robots:
                expected, hint = suggest(fleet.robots, name)
                yield Finding(_path(topic, "sources", str(index)), "no such robot", expected, name, hint)


@fleet_rule(
    "MC711",
    Severity.WARNING,
    "A topic has no effective destination",
    why="Its only destination is its only source, or it has none: it uses resources and delivers nothing.",
    fix="Name other destinations, or remove the topic.",
    failing="topics: {commands: {sources: [base-station], destinations: [base-station]}}",
    passing="topics: {commands: {sources: [base-station], destinations: [husky1]}}",
)
def topic_to_itself(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for topic in fleet.topics:
        if not topic.destinations or (
            topic.sources and set(topic.destinations) == set(topic.sources) and len(topic.sources) == 1
        ):
            found = join_limited(topic.destinations) or "none"
            yield Finding(_path(topic, "destinations"), "reaches no other robot", "another robot, or all", found)
