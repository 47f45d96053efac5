"""Topics: delivery, names, differences, subscriptions (MC712 to MC728)."""

from __future__ import annotations

import re
from collections.abc import Iterator

from meshctl.diagnostics import Severity
from meshctl.lint.context import LintContext
from meshctl.lint.openwrt_names import one_edit_apart
from meshctl.lint.ros_types import MESSAGES
from meshctl.lint.rule import Finding, fleet_rule
from meshctl.model import Fleet, Outbox, Topic, TopicClass
from meshctl.resolve import has_routed_lans
from meshctl.suggest import nearest, suggestion
from meshctl.wording import counted, join_limited

_ALL = "all"
# at 5 % loss 0.95**32, one in five, of such best-effort messages arrive
_BEST_EFFORT_FRAGMENTS = 32
# ROS 1: package/Type; ROS 2: package/msg/Type
_TYPE = re.compile(r"[A-Za-z][A-Za-z0-9_]*/((msg|srv|action)/)?[A-Za-z][A-Za-z0-9_]*")
_TOPIC = re.compile(r"/?[A-Za-z][A-Za-z0-9_]*(/[A-Za-z][A-Za-z0-9_]*)*")
# udp_mesh keeps no shorter message as the base of a difference
_MIN_BASE_BYTES = 32
# udp_mesh compares at most so many bytes of a topic per second, those of the bases included
_COMPARED_BYTES_PER_S = 32 << 20
# udp_mesh sends topics of these levels whether they are read or not
_URGENT_PRIORITY = 3
# names and payload of a message that udp_mesh broadcasts in one datagram of 1500 bytes: less IPv6 and UDP (48), the
# sealed header (23), announcement and head (30), and the legacy format's header (14)
_BROADCAST_BYTES = 1385
# their content is compressed already; ROS 2 writes msg/ in between
_COMPRESSED_TYPES = frozenset(
    {
        "sensor_msgs/CompressedImage",
        "theora_image_transport/Packet",
        "ffmpeg_image_transport_msgs/FFMPEGPacket",
        "point_cloud_interfaces/CompressedPointCloud2",
    }
)


# a frame that is retransmitted a few times, and its queue, on one link
_MIN_DEADLINE_S = 0.02


def _path(topic: Topic, *key: str) -> tuple[str, ...]:
    return ("topics", topic.name, *key)


@fleet_rule(
    "MC712",
    Severity.WARNING,
    "Video is sent reliably",
    why="""Retransmitting old frames delays new ones: on a bad link, reliable video falls minutes behind and fills the
    queue with obsolete frames.""",
    fix="Set `reliable: false` and `keep_last: 1`.",
    failing="topics: {video: {reliable: true}}",
    passing="topics: {video: {reliable: false}}",
)
def video_reliable(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for topic in fleet.topics:
        # an adapted topic needs the outcomes; MC722 has it keep the newest frame only
        is_adapted = topic.reduce is not None and topic.reduce.adapt
        if topic.topic_class is TopicClass.VIDEO and topic.reliable and not is_adapted:
            yield Finding(_path(topic, "reliable"), "old frames delay new ones", "false", "true")


@fleet_rule(
    "MC713",
    Severity.WARNING,
    "A best-effort message is too large to arrive",
    why="""A message arrives only if every fragment does. At 5 % loss, a message of 32 fragments arrives one time in
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
            found = f"{counted(fragments, 'fragment')}; {0.95**fragments:.0%} arrive at 5 % loss"
            yield Finding(_path(topic, "size_bytes"), "lost if any fragment is lost", expected, found)


@fleet_rule(
    "MC714",
    Severity.WARNING,
    "An outbox keeps messages that will have expired",
    why="""Messages wait for an offline peer, but their deadline passes before the peer counts as offline: the outbox is
    always empty when the peer returns.""",
    fix="Increase `deadline_s`, or remove the outbox.",
    failing="topics: {commands: {outbox: last, deadline_s: 5}}",
    passing="topics: {commands: {outbox: last, deadline_s: 600}}",
)
def outbox_expires(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    offline_s = fleet.udp_mesh.offline_after_s
    for topic in fleet.topics:
        if topic.outbox is not Outbox.NONE and topic.deadline_s is not None and topic.deadline_s <= offline_s:
            expected = f"more than {offline_s:g} s (udp_mesh.offline_after_s)"
            path = _path(topic, "deadline_s")
            yield Finding(path, "expires before the peer returns", expected, f"{topic.deadline_s:g} s")


@fleet_rule(
    "MC715",
    Severity.ERROR,
    "An outbox is smaller than one message",
    why="No message fits: it is dropped at once instead of being kept for an offline peer.",
    fix="Increase `outbox_bytes` to several messages.",
    failing="topics: {artifacts: {outbox: all, outbox_bytes: 10000, size_bytes: 60000}}",
    passing="topics: {artifacts: {outbox: all, outbox_bytes: 6000000, size_bytes: 60000}}",
)
def outbox_too_small(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for topic in fleet.topics:
        if topic.outbox is not Outbox.NONE and topic.outbox_bytes < topic.size_bytes:
            path = _path(topic, "outbox_bytes")
            yield Finding(path, "no message fits", f"at least {topic.size_bytes}", str(topic.outbox_bytes))


@fleet_rule(
    "MC716",
    Severity.WARNING,
    "A best-effort topic has an outbox",
    why="Best effort means now or never: kept messages would be sent once, without an acknowledgment.",
    fix="Set `reliable: true`, or remove the outbox.",
    failing="topics: {video: {outbox: all}}",
    passing="topics: {video: {outbox: none}}",
)
def outbox_best_effort(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for topic in fleet.topics:
        if topic.outbox is not Outbox.NONE and not topic.reliable:
            yield Finding(
                _path(topic, "outbox"),
                "kept, but not delivered reliably",
                "none, or reliable: true",
                topic.outbox.value,
            )


@fleet_rule(
    "MC717",
    Severity.WARNING,
    "A topic's type is not a ROS type",
    why="The bridge looks up the type by this name; without it, the bridge passes nothing.",
    fix="Write `package/Type` (ROS 1) or `package/msg/Type` (ROS 2).",
    failing="topics: {commands: {type: String}}",
    passing="topics: {commands: {type: std_msgs/String}}",
)
def type_invalid(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for topic in fleet.topics:
        if topic.type_name and _TYPE.fullmatch(topic.type_name) is None:
            expected = "package/Type or package/msg/Type"
            yield Finding(_path(topic, "type"), "not a ROS type name", expected, topic.type_name)


@fleet_rule(
    "MC718",
    Severity.ERROR,
    "A topic's name is not a ROS name",
    why="ROS rejects names with spaces, hyphens or a part that starts with a digit: the bridge does not start.",
    fix="Use letters, digits and underscores, parts joined by slashes.",
    failing="topics: {map-diffs: {priority: 8, class: map, type: std_msgs/String, rate_hz: 0.1, size_bytes: 1000}}",
    passing="topics: {map_diffs: {priority: 8, class: map, type: std_msgs/String, rate_hz: 0.1, size_bytes: 1000}}",
)
def topic_name_invalid(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for topic in fleet.topics:
        if _TOPIC.fullmatch(topic.name) is None:
            expected = "letters, digits and underscores, parts joined by /"
            yield Finding(_path(topic), "not a valid ROS name", expected, topic.name)


@fleet_rule(
    "MC719",
    Severity.ERROR,
    "A log has settings that contradict it",
    why="""The items of a shared log wait in the log itself, for all their readers. The daemon refuses a topic that is a
    log and also best effort, limited to its last messages, kept in an outbox, or sent as differences.""",
    fix="Remove the other setting, or `log`.",
    failing="topics: {artifacts: {log: {}, outbox: all}}",
    passing="topics: {artifacts: {log: {}, outbox: none}}",
)
def log_contradicted(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for topic in fleet.topics:
        if topic.log is None:
            continue
        for key, found, is_set in (
            ("reliable", "false", not topic.reliable),
            ("keep_last", str(topic.keep_last), bool(topic.keep_last)),
            ("deadline_s", f"{topic.deadline_s} s", topic.deadline_s is not None),
            ("outbox", topic.outbox.value, topic.outbox is not Outbox.NONE),
            ("repair", "true", topic.repair),
            ("delta", "true", topic.delta),
        ):
            if is_set:
                yield Finding(_path(topic, key), f"{topic.name} is a shared log", f"no {key} beside log", found)


@fleet_rule(
    "MC720",
    Severity.WARNING,
    "Differences save nothing on a topic",
    why="""With `delta`, a message is sent as the difference to the last one that its receiver has. udp_mesh sends
    messages below 32 bytes or above `delta_bytes` whole, as well as those to all that fit one datagram. It compares at
    most 32 MiB of a topic per second, and finds nothing in common in data compressed already, such as JPEG.""",
    fix="Remove `delta`, or change what the finding names: `delta_bytes`, the destinations, or the rate.",
    failing="topics: {video: {type: sensor_msgs/CompressedImage, delta: true}}",
    passing="topics: {map: {type: nav_msgs/OccupancyGrid, delta: true, keep_last: 1}}",
)
def delta_without_gain(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    can_broadcast = fleet.udp_mesh.broadcast and not has_routed_lans(fleet)
    for topic in fleet.topics:
        # MC719 covers logs
        if not topic.delta or topic.log is not None:
            continue
        if topic.type_name.replace("/msg/", "/") in _COMPRESSED_TYPES:
            yield Finding(_path(topic, "delta"), "compressed already", "false for this type", topic.type_name)
        size, names = topic.size_bytes, len((topic.name + topic.type_name).encode())
        if 0 < size < _MIN_BASE_BYTES:
            expected = f"messages of at least {_MIN_BASE_BYTES} bytes"
            yield Finding(_path(topic, "delta"), "every message is sent whole", expected, f"{size} bytes")
        elif size and can_broadcast and _ALL in topic.destinations and size + names <= _BROADCAST_BYTES:
            expected, found = "named destinations, or false", f"{size} bytes to all"
            yield Finding(_path(topic, "delta"), "broadcast whole, in one datagram", expected, found)
        elif size > topic.delta_bytes:
            path = _path(topic, "delta_bytes")
            yield Finding(path, "every message is sent whole", f"at least {size} (size_bytes)", str(topic.delta_bytes))
        elif 2 * size * topic.sent_rate_hz > _COMPARED_BYTES_PER_S:
            expected = f"at most {_COMPARED_BYTES_PER_S} bytes/s with their bases"
            found = f"{topic.sent_rate_hz:g} Hz x 2 x {size} bytes"
            yield Finding(_path(topic, "delta"), "part of the messages is sent whole", expected, found)


@fleet_rule(
    "MC725",
    Severity.WARNING,
    "`always` has no effect on a topic",
    why="""With `always`, a topic is sent to robots whose programs do not read it. udp_mesh does that in any case for
    urgent topics (priority 0 to 3), topics with an outbox and shared logs, and with `selective: false` for all.""",
    fix="Remove `always`.",
    failing="topics: {commands: {priority: 3, always: true}}",
    passing="topics: {telemetry: {always: true}}",
)
def always_without_effect(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for topic in fleet.topics:
        reason = _always_sent(fleet, topic) if topic.always else ""
        if reason:
            yield Finding(_path(topic, "always"), f"sent in any case: {reason}", "false", "true")


def _always_sent(fleet: Fleet, topic: Topic) -> str:
    """Why the topic is sent whether it is read or not; empty if it is not."""
    if not fleet.udp_mesh.selective:
        return "udp_mesh.selective is false"
    if topic.priority <= _URGENT_PRIORITY:
        return f"priority {topic.priority} is urgent"
    if topic.log is not None:
        return "it is a shared log"
    return f"its outbox is {topic.outbox.value}" if topic.outbox is not Outbox.NONE else ""


@fleet_rule(
    "MC726",
    Severity.WARNING,
    "A topic's type does not exist in ROS",
    why="""The packages that come with ROS have a fixed set of messages, and no package has almost the name of one of
    them. The bridge finds no message of this name, so nothing is passed on the topic.""",
    fix="Write the message's name as `rosmsg show` or `ros2 interface show` know it.",
    failing="topics: {commands: {type: std_msgs/Boolean}}",
    passing="topics: {commands: {type: my_msgs/Boolean}}",
)
def type_unknown(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for topic in fleet.topics:
        package, _, rest = topic.type_name.partition("/")
        known = MESSAGES.get(package, frozenset())
        name = rest.removeprefix("msg/")
        if known and "/" not in name and _TYPE.fullmatch(topic.type_name) is not None and name not in known:
            near = [topic.type_name.removesuffix(name) + known_name for known_name in nearest(name, sorted(known))]
            expected, hint = " or ".join(near) or f"a message of {package}", suggestion(near)
            yield Finding(_path(topic, "type"), f"{package} has no such message", expected, topic.type_name, hint)
        elif rest and not known and (packages := one_edit_apart(package, MESSAGES)):
            near = [f"{other}/{rest}" for other in packages]
            message = f"{package} is no package of ROS"
            yield Finding(_path(topic, "type"), message, " or ".join(near), topic.type_name, suggestion(near))


@fleet_rule(
    "MC727",
    Severity.WARNING,
    "The base station cannot send the emergency stop",
    why="""The operator at the base station presses the stop, but the topic is bridged from other robots only: nothing
    is sent.""",
    fix="Add the base station to `sources`.",
    failing="topics: {estop: {sources: [husky1]}}",
    passing="topics: {estop: {sources: [base-station]}}",
)
def stop_not_from_base(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    bases = [name for name, robot in fleet.robots.items() if robot.is_base]
    stops = [topic for topic in fleet.topics if topic.topic_class is TopicClass.EMERGENCY_STOP]
    if not bases or not stops or any(not topic.sources or set(bases) & set(topic.sources) for topic in stops):
        return
    found = join_limited(stops[0].sources)
    yield Finding(_path(stops[0], "sources"), f"{bases[0]} cannot stop the robots", bases[0], found)


@fleet_rule(
    "MC728",
    Severity.WARNING,
    "A topic's deadline is shorter than a link needs",
    why="""A message that waits behind one other, or whose frame is retransmitted, is dropped by its sender: most of the
    topic's messages never arrive, and no error is reported.""",
    fix="Set `deadline_s` in seconds: 2 for two seconds.",
    failing="topics: {video: {deadline_s: 0.002}}",
    passing="topics: {video: {deadline_s: 2}}",
)
def deadline_too_short(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for topic in fleet.topics:
        if topic.deadline_s is not None and topic.deadline_s < _MIN_DEADLINE_S:
            expected = f"at least {_MIN_DEADLINE_S:g} s"
            yield Finding(_path(topic, "deadline_s"), "expires while it is sent", expected, f"{topic.deadline_s:g} s")
