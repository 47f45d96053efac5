"""What the robots say: priorities, destinations, delivery (MC701 to MC718)."""

from __future__ import annotations

import re
from collections.abc import Iterator

from meshctl.diagnostics import Severity
from meshctl.lint.context import LintContext
from meshctl.lint.grouping import group_by_key, join_limited
from meshctl.lint.rule import Finding, fleet_rule
from meshctl.lint.rules.references import suggest
from meshctl.model import Fleet, Outbox, Topic, TopicClass

_ALL = "all"
# what is large and can wait
_BULK = (TopicClass.MAP, TopicClass.VIDEO)
# what a person or a robot waits for
_URGENT = (TopicClass.EMERGENCY_STOP, TopicClass.COMMAND)
# the order in which classes should leave
_ORDER = (
    TopicClass.EMERGENCY_STOP,
    TopicClass.COMMAND,
    TopicClass.ARTIFACT,
    TopicClass.TELEMETRY,
    TopicClass.MAP,
    TopicClass.VIDEO,
)
# a best-effort message of this many fragments arrives with 0.95 to its power: at 5 % loss, one in five
_BEST_EFFORT_FRAGMENTS = 32
# ROS 1: package/Type; ROS 2: package/msg/Type
_TYPE = re.compile(r"[A-Za-z][A-Za-z0-9_]*/((msg|srv|action)/)?[A-Za-z][A-Za-z0-9_]*")
_TOPIC = re.compile(r"/?[A-Za-z][A-Za-z0-9_]*(/[A-Za-z][A-Za-z0-9_]*)*")


def _at(topic: Topic, *key: str) -> tuple[str, ...]:
    return ("topics", topic.name, *key)


@fleet_rule(
    "MC701",
    Severity.ERROR,
    "Something is as urgent as the emergency stop",
    why="""udp_mesh sends strictly by priority, and within one level in turn: whatever shares the emergency stop's
    level, or stands above it, is sent before it, for as long as there is any.""",
    fix="Give the emergency stop a level of its own, 0, and everything else a larger number.",
    failing="topics: {commands: {priority: 0}}",
    passing="topics: {commands: {priority: 1}}",
)
def stop_not_first(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    stops = [topic for topic in fleet.topics if topic.topic_class is TopicClass.EMERGENCY_STOP]
    if not stops:
        return
    level = max(stop.priority for stop in stops)
    for topic in fleet.topics:
        if topic.topic_class is not TopicClass.EMERGENCY_STOP and topic.priority <= level:
            message = f"can hold up {stops[0].name}"
            yield Finding(_at(topic, "priority"), message, f"more than {level}", str(topic.priority))


@fleet_rule(
    "MC702",
    Severity.ERROR,
    "Bulk is as urgent as commands",
    why="""Maps and video fill every gap in the air. On the level of commands, or above, they fill it before the
    supervisor's orders.""",
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
        # on the stop's own level it is MC701's to say
        if topic.topic_class in _BULK and topic.priority <= last.priority and topic.priority > max(stops, default=-1):
            message = f"can hold up {last.name}"
            yield Finding(_at(topic, "priority"), message, f"more than {last.priority}", str(topic.priority))


@fleet_rule(
    "MC703",
    Severity.WARNING,
    "Topics of different classes share a priority",
    why="""On one level topics take turns: a large map piece delays a telemetry message by as many fragments as it has.
    Nobody decided that.""",
    fix="Give each class a level of its own: there are sixteen.",
    failing="topics: {telemetry: {priority: 3}}",
    passing="topics: {telemetry: {priority: 4}}",
)
def classes_tie(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for level, topics in group_by_key((topic.priority, topic) for topic in fleet.topics).items():
        classes = dict.fromkeys(topic.topic_class for topic in topics if topic.topic_class is not TopicClass.OTHER)
        if len(classes) > 1 and not any(topic.topic_class in _URGENT for topic in topics):
            later = next(topic for topic in topics if topic.topic_class is not topics[0].topic_class)
            found = f"{level} for {join_limited([topic.name for topic in topics])}"
            yield Finding(_at(later, "priority"), f"takes turns with {topics[0].name}", "a level of its own", found)


@fleet_rule(
    "MC704",
    Severity.WARNING,
    "A class is more urgent than a class that should go before it",
    why="""Reports of artifacts are what the run is scored by; telemetry comes again in a second, a map piece can wait a
    minute. An order that is turned around is usually a slip of one number.""",
    fix="Order the levels: emergency stop, command, artifact, telemetry, map, video.",
    failing="topics: {telemetry: {priority: 10}}",
    passing="topics: {telemetry: {priority: 4}}",
)
def order_turned(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    # urgent classes against bulk are errors of their own (MC701, MC702)
    commands = max((t.priority for t in fleet.topics if t.topic_class is TopicClass.COMMAND), default=-1)
    ranked = [
        topic
        for topic in fleet.topics
        if topic.topic_class in _ORDER[1:] and not (topic.topic_class in _BULK and topic.priority <= commands)
    ]
    latest: Topic | None = None
    for topic in sorted(ranked, key=lambda topic: (_ORDER.index(topic.topic_class), topic.priority)):
        if latest is not None and topic.topic_class is not latest.topic_class and topic.priority < latest.priority:
            message = f"{topic.topic_class.value} goes before {latest.name} ({latest.topic_class.value})"
            expected = f"more than {latest.priority}"
            yield Finding(_at(topic, "priority"), message, expected, str(topic.priority))
        if latest is None or topic.priority > latest.priority:
            latest = topic


@fleet_rule(
    "MC705",
    Severity.WARNING,
    "There is no emergency stop",
    why="""A fleet of robots that can be told everything but to stop. If the stop goes another way, say so in a
    suppression.""",
    fix="Add a topic of `class: emergency_stop` with priority 0.",
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
    why="A lost datagram is not sent again: the operator presses the button and one robot keeps walking.",
    fix="Set `reliable: true`.",
    failing="topics: {estop: {reliable: false}}",
    passing="topics: {estop: {reliable: true}}",
)
def stop_best_effort(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for topic in fleet.topics:
        if topic.topic_class is TopicClass.EMERGENCY_STOP and not topic.reliable:
            yield Finding(_at(topic, "reliable"), "may be lost", "true", "false")


@fleet_rule(
    "MC707",
    Severity.ERROR,
    "The emergency stop does not reach every robot",
    why="A robot that was added later, or forgotten, does not stop with the others.",
    fix="Write `destinations: [all]`.",
    failing="topics: {estop: {sources: [husky1], destinations: [base-station]}}",
    passing="topics: {estop: {destinations: [all]}}",
)
def stop_not_for_all(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for topic in fleet.topics:
        if topic.topic_class is not TopicClass.EMERGENCY_STOP or _ALL in topic.destinations:
            continue
        missing = [name for name, robot in fleet.robots.items() if not robot.is_base and name not in topic.destinations]
        if missing:
            yield Finding(
                _at(topic, "destinations"),
                f"{join_limited(missing)} would not stop",
                "all",
                join_limited(topic.destinations),
            )


@fleet_rule(
    "MC708",
    Severity.ERROR,
    "The emergency stop is held back",
    why="""A rate limit or a deadline drops exactly the stop that was pressed twice, or that came late because the link
    was bad.""",
    fix="Take `rate_limit_bytes_per_s` and `deadline_s` away from the emergency stop.",
    failing="topics: {estop: {deadline_s: 1}}",
    passing="topics: {estop: {keep_last: 1}}",
)
def stop_held_back(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for topic in fleet.topics:
        if topic.topic_class is not TopicClass.EMERGENCY_STOP:
            continue
        if topic.deadline_s is not None:
            yield Finding(_at(topic, "deadline_s"), "a late stop is dropped", "none", f"{topic.deadline_s:g} s")
        if topic.rate_limit_bytes_per_s is not None:
            found = f"{topic.rate_limit_bytes_per_s} bytes/s"
            yield Finding(_at(topic, "rate_limit_bytes_per_s"), "a repeated stop waits", "none", found)


@fleet_rule(
    "MC709",
    Severity.ERROR,
    "A destination does not exist",
    why="Messages for a peer that nobody is wait until they expire; the reader believes they are delivered.",
    fix="Name a robot of `robots`, or `all`.",
    failing="topics: {commands: {destinations: [husky1, huskey2]}}",
    passing="topics: {commands: {destinations: [husky1]}}",
)
def destination_unknown(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for topic in fleet.topics:
        for index, name in enumerate(topic.destinations):
            if name != _ALL and name not in fleet.robots:
                expected, hint = suggest((*fleet.robots, _ALL), name)
                yield Finding(_at(topic, "destinations", str(index)), "no such robot", expected, name, hint)


@fleet_rule(
    "MC710",
    Severity.ERROR,
    "A source does not exist",
    why="The topic is bridged on no robot: nothing is ever sent, and nothing says so.",
    fix="Name a robot of `robots`, or leave `sources` out for all of them.",
    failing="topics: {commands: {sources: [base]}}",
    passing="topics: {commands: {sources: [base-station]}}",
)
def source_unknown(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for topic in fleet.topics:
        for index, name in enumerate(topic.sources):
            if name not in fleet.robots:
                expected, hint = suggest(fleet.robots, name)
                yield Finding(_at(topic, "sources", str(index)), "no such robot", expected, name, hint)


@fleet_rule(
    "MC711",
    Severity.WARNING,
    "A topic goes nowhere",
    why="Its only destination is its only source, or it has none: it takes memory and settings, and carries nothing.",
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
            yield Finding(_at(topic, "destinations"), "reaches nobody else", "another robot, or all", found)


@fleet_rule(
    "MC712",
    Severity.WARNING,
    "Video is sent reliably",
    why="""Sending an old frame again delays the new one: on a bad link a reliable video falls minutes behind, and fills
    the queue with what nobody wants to see any more.""",
    fix="Set `reliable: false`, with `keep_last: 1`.",
    failing="topics: {video: {reliable: true}}",
    passing="topics: {video: {reliable: false}}",
)
def video_reliable(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for topic in fleet.topics:
        if topic.topic_class is TopicClass.VIDEO and topic.reliable:
            yield Finding(_at(topic, "reliable"), "old frames delay new ones", "false", "true")


@fleet_rule(
    "MC713",
    Severity.WARNING,
    "A best-effort message is too large to arrive",
    why="""A message arrives when each of its fragments does. At 5 % loss a message of 32 fragments arrives one time in
    five.""",
    fix="Send smaller messages, or set `reliable: true` or `repair: true`.",
    failing="topics: {video: {size_bytes: 200000}}",
    passing="topics: {video: {size_bytes: 5000}}",
)
def best_effort_large(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for topic in fleet.topics:
        fragments = -(-topic.size_bytes // fleet.udp_mesh.fragment_bytes)
        if not topic.reliable and not topic.repair and fragments > _BEST_EFFORT_FRAGMENTS:
            expected = f"at most {_BEST_EFFORT_FRAGMENTS} fragments"
            found = f"{fragments} fragments; {0.95**fragments:.0%} arrive at 5 % loss"
            yield Finding(_at(topic, "size_bytes"), "lost when one fragment is", expected, found)


@fleet_rule(
    "MC714",
    Severity.WARNING,
    "An outbox keeps what will have expired",
    why="""Messages wait for an offline peer, but their deadline passes before a peer even counts as offline: the outbox
    is always empty when the peer comes back.""",
    fix="Lengthen `deadline_s`, or take the outbox away.",
    failing="topics: {commands: {outbox: last, deadline_s: 5}}",
    passing="topics: {commands: {outbox: last, deadline_s: 600}}",
)
def outbox_expires(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    offline_s = fleet.udp_mesh.offline_after_s
    for topic in fleet.topics:
        if topic.outbox is not Outbox.NONE and topic.deadline_s is not None and topic.deadline_s <= offline_s:
            expected = f"more than {offline_s:g} s (udp_mesh.offline_after_s)"
            path = _at(topic, "deadline_s")
            yield Finding(path, "expired before the peer is back", expected, f"{topic.deadline_s:g} s")


@fleet_rule(
    "MC715",
    Severity.ERROR,
    "An outbox holds less than one message",
    why="Nothing fits: what was to be kept for an offline peer is dropped at once.",
    fix="Raise `outbox_bytes` to several messages.",
    failing="topics: {artifacts: {outbox: all, outbox_bytes: 10000, size_bytes: 60000}}",
    passing="topics: {artifacts: {outbox: all, outbox_bytes: 6000000, size_bytes: 60000}}",
)
def outbox_too_small(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for topic in fleet.topics:
        if topic.outbox is not Outbox.NONE and topic.outbox_bytes < topic.size_bytes:
            path = _at(topic, "outbox_bytes")
            yield Finding(path, "not one message fits", f"at least {topic.size_bytes}", str(topic.outbox_bytes))


@fleet_rule(
    "MC716",
    Severity.WARNING,
    "A best-effort topic has an outbox",
    why="""Best effort means: now or never. Kept messages would be sent once, without anybody learning whether they
    arrived.""",
    fix="Set `reliable: true`, or take the outbox away.",
    failing="topics: {video: {outbox: all}}",
    passing="topics: {video: {outbox: none}}",
)
def outbox_best_effort(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for topic in fleet.topics:
        if topic.outbox is not Outbox.NONE and not topic.reliable:
            yield Finding(_at(topic, "outbox"), "kept but not delivered", "none, or reliable: true", topic.outbox.value)


@fleet_rule(
    "MC717",
    Severity.WARNING,
    "A topic's type is not a ROS type",
    why="""The bridge looks the type up by this name to subscribe and publish: a type it cannot find ends in a bridge
    that passes nothing.""",
    fix="Write `package/Type` (ROS 1) or `package/msg/Type` (ROS 2).",
    failing="topics: {commands: {type: String}}",
    passing="topics: {commands: {type: std_msgs/String}}",
)
def type_invalid(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for topic in fleet.topics:
        if topic.type_name and _TYPE.fullmatch(topic.type_name) is None:
            expected = "package/Type or package/msg/Type"
            yield Finding(_at(topic, "type"), "the bridge cannot find it", expected, topic.type_name)


@fleet_rule(
    "MC718",
    Severity.ERROR,
    "A topic's name is not a ROS name",
    why="ROS refuses names with spaces, hyphens or a digit at the start of a part: the bridge does not start.",
    fix="Use letters, digits and underscores, parts joined by slashes.",
    failing="topics: {map-diffs: {priority: 8, class: map, type: std_msgs/String, rate_hz: 0.1, size_bytes: 1000}}",
    passing="topics: {map_diffs: {priority: 8, class: map, type: std_msgs/String, rate_hz: 0.1, size_bytes: 1000}}",
)
def topic_name_invalid(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for topic in fleet.topics:
        if _TOPIC.fullmatch(topic.name) is None:
            expected = "letters, digits and underscores, parts joined by /"
            yield Finding(_at(topic), "ROS refuses the name", expected, topic.name)
