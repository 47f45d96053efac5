"""Alarms of a robot that answers, one function per concern: computer, daemon, ROS bridge, peers, queues, topics.

Some compare several robots: a version other than most, a key that another robot lacks, a peer that is not heard.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

from meshctl.fleet.journal import LastKnown
from meshctl.model import Fleet, Robot
from meshctl.report.duration import duration
from meshctl.robots.facts import RobotFacts, ServiceFacts
from meshctl.status.thin_alarms import thin_alarms
from meshctl.status.topics import is_urgent, urgent_priorities
from meshctl.status.values import Alarm, Level, TopicStatus
from meshctl.wording import counted

# A healthy hop takes milliseconds; a longer wait means a broken or congested link.
URGENT_WAIT_S = 2.0
# Snapshots further apart do not show whether a queue grows.
GROWING_WITHIN_S = 300.0
# Recordings of several robots are merged by time. SSH and a shell add up to two seconds; more is a wrong clock.
CLOCK_TOLERANCE_S = 5.0
LOW_MEMORY_SHARE = 0.05
BUSY_LOAD = 3.0
# Logs, recordings and stored messages fill a disk; below FULL_DISK_KIB the next deploy fails.
LOW_DISK_SHARE, LOW_DISK_KIB = 0.10, 2 << 20
FULL_DISK_KIB = 64 << 10
MAX_DRIFT_LINES = 3


@dataclass(frozen=True, slots=True)
class RobotAlarmInput:
    """Everything known about one robot that answers. `robots` are the facts of all that answer, by name; `last` is what
    was known before this snapshot; `topics` are assessed already."""

    fleet: Fleet
    robot: Robot
    facts: RobotFacts
    robots: Mapping[str, RobotFacts]
    topics: tuple[TopicStatus, ...]
    last: LastKnown | None
    urgent_bytes: int

    @property
    def daemons(self) -> dict[str, RobotFacts]:
        """The other robots whose daemon answers."""
        return {name: other for name, other in self.robots.items() if other.answers and name != self.robot.name}


def urgent_bytes(fleet: Fleet, facts: RobotFacts) -> int:
    """Queued bytes at the priorities of emergency stops and commands."""
    urgent = urgent_priorities(fleet)
    return sum(queue.bytes for queue in facts.queues if queue.priority in urgent)


def robot_alarms(facts: RobotAlarmInput) -> tuple[Alarm, ...]:
    """All alarms of a robot, most severe first."""
    found = [alarm for concern in _CONCERNS for alarm in concern(facts)]
    return tuple(sorted(found, key=lambda alarm: -alarm.level))


def _daemon(given: RobotAlarmInput) -> Iterator[Alarm]:
    facts, name = given.facts, given.robot.name
    if not facts.is_installed:
        yield Alarm(Level.ERROR, "not-installed", "udp_mesh is not installed", f"meshctl robots deploy {name}")
        return
    if not facts.service.is_up:
        result = f" ({facts.service.result})" if facts.service.result not in ("", "success") else ""
        text = f"its daemon is {facts.service.active or 'absent'}{result}"
        yield Alarm(Level.ERROR, "daemon", text, f"meshctl robots logs {name}; then meshctl robots restart {name}")
    elif not facts.answers:
        hint = f"meshctl robots logs {name}; then meshctl robots restart {name}"
        yield Alarm(Level.ERROR, "daemon", "its daemon runs but does not answer", hint)
    if not facts.is_proven:
        text = "a switch to another release was interrupted"
        yield Alarm(Level.WARNING, "unproven", text, f"meshctl robots deploy {name}")
    if facts.bridge is not None and not facts.bridge.is_up:
        text = f"its ROS bridge is {facts.bridge.active or 'absent'}"
        yield Alarm(
            Level.ERROR,
            "ros-bridge",
            text,
            "start roscore if it is down; then check the bridge's journal",
        )
    if facts.hosts is not None and not facts.hosts.is_up:
        text = f"its service for /etc/hosts is {facts.hosts.active or 'absent'}"
        yield Alarm(Level.WARNING, "hosts", text, f"meshctl robots logs {name}; then meshctl robots restart {name}")
    if facts.collector is not None:
        yield from _collector(facts.collector, facts.collector_problem, name)


def _collector(service: ServiceFacts, problem: str, name: str) -> Iterator[Alarm]:
    if not service.is_up:
        hint = f"meshctl robots logs {name}; then meshctl robots restart {name}"
        yield Alarm(Level.WARNING, "collector", f"its collector is {service.active or 'absent'}", hint)
    elif problem:
        hint = "see with meshctl plan whether its radios accept its key; then check their power and cables"
        yield Alarm(Level.WARNING, "collector", f"its collector: {problem}", hint)


def _restarts(facts: RobotAlarmInput) -> Iterator[Alarm]:
    before = facts.last.facts.get("restarts", "") if facts.last else ""
    again = facts.facts.service.restarts - int(before) if before.isdecimal() else 0
    if again > 0:
        text = f"its daemon crashed and was restarted {counted(again, 'time')} since the last snapshot"
        yield Alarm(Level.WARNING, "restarts", text, f"meshctl robots logs {facts.robot.name} -n 200")
    uptime_s = facts.facts.computer.uptime_s
    since_s = facts.facts.seen_s - facts.last.seen_s if facts.last else None
    if uptime_s is not None and since_s is not None and uptime_s < since_s:
        yield Alarm(Level.NOTE, "rebooted", f"rebooted {duration(uptime_s)} ago")


def _drift(given: RobotAlarmInput) -> Iterator[Alarm]:
    facts, name = given.facts, given.robot.name
    if facts.drift and facts.release:
        more = len(facts.drift) - MAX_DRIFT_LINES
        text = "; ".join(facts.drift[:MAX_DRIFT_LINES]) + (f"; and {more} more" if more > 0 else "")
        hint = f"meshctl robots diff {name}; meshctl robots deploy {name} fixes it"
        yield Alarm(Level.WARNING, "drift", text, hint)
    versions = Counter(daemon.version for daemon in (*given.daemons.values(), facts) if daemon.answers)
    if facts.answers and len(versions) > 1:
        usual = max(versions, key=lambda version: (versions[version], version))
        if facts.version != usual:
            text = f"its daemon has version {facts.version}, most others {usual}"
            yield Alarm(Level.WARNING, "version", text, "meshctl robots deploy")


def _keys(given: RobotAlarmInput) -> Iterator[Alarm]:
    facts = given.facts
    if facts.unkeyed:
        level = Level.ERROR if given.fleet.udp_mesh.keys else Level.NOTE
        hint = f"meshctl robots deploy {given.robot.name}" if given.fleet.udp_mesh.keys else "set udp_mesh.keys"
        yield Alarm(level, "unkeyed", "its daemon neither encrypts nor authenticates", hint)
    elif facts.keys:
        lacking = [name for name, daemon in given.daemons.items() if daemon.keys and facts.keys[0] not in daemon.keys]
        if lacking:
            text = f"its messages cannot be decrypted by {', '.join(lacking)}"
            yield Alarm(Level.ERROR, "key", text, "meshctl robots deploy, or continue with meshctl robots rotate-key")


def _peers(facts: RobotAlarmInput) -> Iterator[Alarm]:
    if not facts.facts.answers:
        return
    missing = [name for name in facts.daemons if name not in facts.facts.online and name in facts.fleet.robots]
    if missing:
        others = len(facts.daemons)
        text = f"does not hear {', '.join(missing)}" + (f", of {others} whose daemons run" if others > 1 else "")
        yield Alarm(Level.ERROR, "peers", text, "check the radios between them with meshctl topology")


def _queues(facts: RobotAlarmInput) -> Iterator[Alarm]:
    urgent = urgent_priorities(facts.fleet)
    late = [queue for queue in facts.facts.queues if queue.priority in urgent and queue.oldest_s > URGENT_WAIT_S]
    if not late:
        return
    last = facts.last
    is_recent = last is not None and facts.facts.seen_s - last.seen_s <= GROWING_WITHIN_S
    before = last.facts.get("urgent_bytes", "") if last is not None and is_recent else ""
    grows = before.isdecimal() and facts.urgent_bytes > int(before)
    messages, oldest_s = sum(queue.messages for queue in late), max(queue.oldest_s for queue in late)
    text = f"{counted(messages, 'urgent message')} queued, the oldest for {duration(oldest_s)}"
    text += f", and growing ({before} to {facts.urgent_bytes} B)" if grows else ""
    level = Level.ERROR if grows else Level.WARNING
    yield Alarm(level, "urgent-queue", text, f"meshctl robots status {facts.robot.name} shows the unreachable peers")


def _topics(facts: RobotAlarmInput) -> Iterator[Alarm]:
    if not facts.facts.answers:
        return
    urgent = {topic.name for topic in facts.fleet.topics if is_urgent(topic)}
    hints = {
        "undeclared": f"meshctl robots deploy {facts.robot.name}",
        "silent": "check that the publishing program runs",
        "not-arriving": "check meshctl robots status, and the path between them with meshctl topology",
    }
    for code, hint in hints.items():
        bad = [topic for topic in facts.topics if topic.code == code]
        if bad:
            is_worse = code != "silent" and any(topic.name in urgent for topic in bad)
            text = "; ".join(f"{topic.name}: {topic.problem}" for topic in bad)
            yield Alarm(Level.ERROR if is_worse else Level.WARNING, f"topic-{code}", text, hint)


def _computer(facts: RobotAlarmInput) -> Iterator[Alarm]:
    computer, name = facts.facts.computer, facts.robot.name
    if computer.disk_kib:
        free = f"{size(computer.disk_free_kib)} of {size(computer.disk_kib)} of disk left"
        if computer.disk_free_kib < FULL_DISK_KIB:
            yield Alarm(Level.ERROR, "disk", free, f"free disk space on {name}: recordings and logs first")
        elif computer.disk_free_kib < min(LOW_DISK_KIB, LOW_DISK_SHARE * computer.disk_kib):
            yield Alarm(Level.WARNING, "disk", free, f"free disk space on {name}: recordings and logs first")
    if computer.memory_kib and computer.memory_free_kib / computer.memory_kib < LOW_MEMORY_SHARE:
        yield Alarm(
            Level.WARNING,
            "memory",
            f"{size(computer.memory_free_kib)} of memory left",
            "stop other programs",
        )
    if computer.load is not None and computer.cpus and computer.load[0] / computer.cpus > BUSY_LOAD:
        text = f"load {computer.load[0]:.1f} on {counted(computer.cpus, 'processor')}"
        yield Alarm(Level.NOTE, "load", text, "stop other programs, which delay the daemon")
    if abs(computer.clock_ahead_s) > CLOCK_TOLERANCE_S:
        side = "ahead of" if computer.clock_ahead_s > 0 else "behind"
        text = f"its clock is {duration(abs(computer.clock_ahead_s))} {side} ours"
        yield Alarm(Level.WARNING, "clock", text, "set it before the mission: recordings are merged by time")


def size(kib: float) -> str:
    """`512 KiB`, `12 MiB`, `3.4 GiB`."""
    for limit, unit_kib, unit in ((1 << 10, 1, "KiB"), (1 << 20, 1 << 10, "MiB"), (1 << 40, 1 << 20, "GiB")):
        if kib < limit:
            value = kib / unit_kib
            return f"{value:.1f} {unit}" if unit == "GiB" and value < 100 else f"{value:.0f} {unit}"
    return f"{kib / (1 << 30):.0f} TiB"


def _others(facts: RobotAlarmInput) -> Iterator[Alarm]:
    """Computers on its switch that the robot's daemon computer does not reach."""
    if facts.facts.answering is None:
        return
    for name, computer in facts.robot.computers.items():
        address = str(computer.address.ip)
        if address not in facts.facts.answering:
            text = f"its computer {name} ({address}) does not answer a ping"
            yield Alarm(Level.WARNING, "computer-silent", text, "check its power, its cable and its address")


_CONCERNS: tuple[Callable[[RobotAlarmInput], Iterator[Alarm]], ...] = (
    _daemon,
    _restarts,
    _drift,
    _keys,
    _peers,
    lambda given: thin_alarms(given.facts),
    _queues,
    _topics,
    _computer,
    _others,
)
