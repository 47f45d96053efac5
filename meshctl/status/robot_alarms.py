"""What is wrong with a robot that answers: its computer, its daemon, its ROS bridge, whom it hears, what waits.

One small function per concern, as for the radios. What several robots tell together is here too: another version than
the rest, a key that another one does not have, a robot that one hears and another does not.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

from meshctl.fleet.journal import LastKnown
from meshctl.model import Fleet, Robot
from meshctl.robots.facts import RobotFacts
from meshctl.status.node_alarms import duration
from meshctl.status.topics import is_urgent, urgent_priorities
from meshctl.status.values import Alarm, Level, TopicStatus

# An urgent message that waits longer than this has met a closed link or a full one; a healthy hop takes milliseconds.
URGENT_WAIT_S = 2.0
# Two looks further apart say nothing about whether a queue grows.
GROWING_WITHIN_S = 300.0
# Stamps of messages and recordings of several robots are merged by time. What SSH and a shell add is below a second or
# two; more is a clock.
CLOCK_TOLERANCE_S = 5.0
LOW_MEMORY_SHARE = 0.05
BUSY_LOAD = 3.0
# Logs, recordings and messages kept for absent robots fill a disk; at the lower bound the next deploy fails.
LOW_DISK_SHARE, LOW_DISK_KIB = 0.10, 2 << 20
FULL_DISK_KIB = 64 << 10
DRIFT_LINES_SHOWN = 3


@dataclass(frozen=True, slots=True)
class RobotAlarmInput:
    """Everything known about one robot that answers. `told` are the facts of every robot that answers, by name; `last`
    is what was known before this look; `topics` are judged already."""

    fleet: Fleet
    robot: Robot
    facts: RobotFacts
    robots: Mapping[str, RobotFacts]
    topics: tuple[TopicStatus, ...]
    last: LastKnown | None
    urgent_bytes: int

    @property
    def daemons(self) -> dict[str, RobotFacts]:
        """The robots whose daemon answers, this one left out."""
        return {name: one for name, one in self.robots.items() if one.answers and name != self.robot.name}


def urgent_bytes(fleet: Fleet, facts: RobotFacts) -> int:
    """What waits on the priorities of emergency stops and commands."""
    urgent = urgent_priorities(fleet)
    return sum(queue.bytes for queue in facts.queues if queue.priority in urgent)


def robot_alarms(seen: RobotAlarmInput) -> tuple[Alarm, ...]:
    """All alarms of a robot, the worst first."""
    found = [alarm for concern in _CONCERNS for alarm in concern(seen)]
    return tuple(sorted(found, key=lambda alarm: -alarm.level))


def _daemon(seen: RobotAlarmInput) -> Iterator[Alarm]:
    facts, name = seen.facts, seen.robot.name
    if not facts.release and not facts.service.enabled:
        yield Alarm(Level.ERROR, "not-installed", "udp_mesh is not installed", f"meshctl robots deploy {name}")
        return
    if not facts.service.is_up:
        result = f" ({facts.service.result})" if facts.service.result not in ("", "success") else ""
        told = f"its daemon is {facts.service.active or 'absent'}{result}"
        yield Alarm(Level.ERROR, "daemon", told, f"meshctl robots logs {name}; then meshctl robots restart {name}")
    elif not facts.answers:
        hint = f"meshctl robots logs {name}; then meshctl robots restart {name}"
        yield Alarm(Level.ERROR, "daemon", "its daemon runs and does not answer", hint)
    if not facts.is_proven:
        told = "a switch to another release was cut short"
        yield Alarm(Level.WARNING, "unproven", told, f"meshctl robots deploy {name}")
    if facts.bridge is not None and not facts.bridge.is_up:
        told = f"its ROS bridge is {facts.bridge.active or 'absent'}"
        yield Alarm(Level.ERROR, "ros-bridge", told, "is roscore up? The bridge waits for it; then look at its journal")


def _restarts(seen: RobotAlarmInput) -> Iterator[Alarm]:
    before = seen.last.facts.get("restarts", "") if seen.last else ""
    again = seen.facts.service.restarts - int(before) if before.isdecimal() else 0
    if again > 0:
        told = f"its daemon died and was started again {again} time{'s' if again > 1 else ''} since the last look"
        yield Alarm(Level.WARNING, "restarts", told, f"meshctl robots logs {seen.robot.name} -n 200")
    uptime_s = seen.facts.computer.uptime_s
    since_s = seen.facts.seen_s - seen.last.seen_s if seen.last else None
    if uptime_s is not None and since_s is not None and uptime_s < since_s:
        yield Alarm(Level.NOTE, "rebooted", f"rebooted {duration(uptime_s)} ago")


def _drift(seen: RobotAlarmInput) -> Iterator[Alarm]:
    facts, name = seen.facts, seen.robot.name
    if facts.drift and facts.release:
        more = len(facts.drift) - DRIFT_LINES_SHOWN
        told = "; ".join(facts.drift[:DRIFT_LINES_SHOWN]) + (f"; and {more} more" if more > 0 else "")
        hint = f"meshctl robots diff {name}; meshctl robots deploy {name} puts it right"
        yield Alarm(Level.WARNING, "drift", told, hint)
    versions = Counter(one.version for one in (*seen.daemons.values(), facts) if one.answers)
    if facts.answers and len(versions) > 1:
        usual = max(versions, key=lambda version: (versions[version], version))
        if facts.version != usual:
            told = f"its daemon is version {facts.version}, most others run {usual}"
            yield Alarm(Level.WARNING, "version", told, "meshctl robots deploy")


def _keys(seen: RobotAlarmInput) -> Iterator[Alarm]:
    facts = seen.facts
    if facts.unkeyed:
        level = Level.ERROR if seen.fleet.udp_mesh.keys else Level.NOTE
        hint = f"meshctl robots deploy {seen.robot.name}" if seen.fleet.udp_mesh.keys else "write udp_mesh.keys"
        yield Alarm(level, "unkeyed", "its daemon neither encrypts nor authenticates", hint)
    elif facts.keys:
        deaf = [name for name, one in seen.daemons.items() if one.keys and facts.keys[0] not in one.keys]
        if deaf:
            told = f"seals with a key that {', '.join(deaf)} cannot open"
            yield Alarm(Level.ERROR, "key", told, "meshctl robots deploy, or go on with meshctl robots rotate-key")


def _peers(seen: RobotAlarmInput) -> Iterator[Alarm]:
    if not seen.facts.answers:
        return
    missing = [name for name in seen.daemons if name not in seen.facts.online and name in seen.fleet.robots]
    if missing:
        others = len(seen.daemons)
        told = f"does not hear {', '.join(missing)}" + (f", of {others} whose daemons run" if others > 1 else "")
        yield Alarm(Level.ERROR, "peers", told, "look at the radios between them: meshctl topology")


def _queues(seen: RobotAlarmInput) -> Iterator[Alarm]:
    urgent = urgent_priorities(seen.fleet)
    late = [queue for queue in seen.facts.queues if queue.priority in urgent and queue.oldest_s > URGENT_WAIT_S]
    if not late:
        return
    last = seen.last
    is_recent = last is not None and seen.facts.seen_s - last.seen_s <= GROWING_WITHIN_S
    before = last.facts.get("urgent_bytes", "") if last is not None and is_recent else ""
    grows = before.isdecimal() and seen.urgent_bytes > int(before)
    messages, oldest_s = sum(queue.messages for queue in late), max(queue.oldest_s for queue in late)
    told = f"{messages} urgent message{'s' if messages > 1 else ''} wait, the oldest for {duration(oldest_s)}"
    told += f", and they grow more ({before} to {seen.urgent_bytes} B)" if grows else ""
    level = Level.ERROR if grows else Level.WARNING
    yield Alarm(level, "urgent-queue", told, f"whom it cannot reach: meshctl robots status {seen.robot.name}")


def _topics(seen: RobotAlarmInput) -> Iterator[Alarm]:
    if not seen.facts.answers:
        return
    urgent = {topic.name for topic in seen.fleet.topics if is_urgent(topic)}
    hints = {
        "undeclared": f"meshctl robots deploy {seen.robot.name}",
        "silent": "is the program that publishes it running?",
        "not-arriving": "meshctl robots status, and the path between them: meshctl topology",
    }
    for code, hint in hints.items():
        bad = [topic for topic in seen.topics if topic.code == code]
        if bad:
            is_worse = code != "silent" and any(topic.name in urgent for topic in bad)
            told = "; ".join(f"{topic.name}: {topic.problem}" for topic in bad)
            yield Alarm(Level.ERROR if is_worse else Level.WARNING, f"topic-{code}", told, hint)


def _computer(seen: RobotAlarmInput) -> Iterator[Alarm]:
    computer, name = seen.facts.computer, seen.robot.name
    if computer.disk_kib:
        free = f"{size(computer.disk_free_kib)} of {size(computer.disk_kib)} of disk left"
        if computer.disk_free_kib < FULL_DISK_KIB:
            yield Alarm(Level.ERROR, "disk", free, f"make room on {name}: recordings and logs first")
        elif computer.disk_free_kib < min(LOW_DISK_KIB, LOW_DISK_SHARE * computer.disk_kib):
            yield Alarm(Level.WARNING, "disk", free, f"make room on {name}: recordings and logs first")
    if computer.memory_kib and computer.memory_free_kib / computer.memory_kib < LOW_MEMORY_SHARE:
        yield Alarm(Level.WARNING, "memory", f"{size(computer.memory_free_kib)} of memory left", "stop what grows")
    if computer.load is not None and computer.cpus and computer.load[0] / computer.cpus > BUSY_LOAD:
        told = f"load {computer.load[0]:.1f} on {computer.cpus} processors"
        yield Alarm(Level.NOTE, "load", told, "the daemon will be late: stop what computes")
    if abs(computer.clock_ahead_s) > CLOCK_TOLERANCE_S:
        side = "ahead of" if computer.clock_ahead_s > 0 else "behind"
        told = f"its clock is {duration(abs(computer.clock_ahead_s))} {side} ours"
        yield Alarm(Level.WARNING, "clock", told, "set it before the run: recordings are merged by time")


def size(kib: float) -> str:
    """`512 KiB`, `12 MiB`, `3.4 GiB`."""
    for limit, unit_kib, unit in ((1 << 10, 1, "KiB"), (1 << 20, 1 << 10, "MiB"), (1 << 40, 1 << 20, "GiB")):
        if kib < limit:
            value = kib / unit_kib
            return f"{value:.1f} {unit}" if unit == "GiB" and value < 100 else f"{value:.0f} {unit}"
    return f"{kib / (1 << 30):.0f} TiB"


_CONCERNS: tuple[Callable[[RobotAlarmInput], Iterator[Alarm]], ...] = (
    _daemon,
    _restarts,
    _drift,
    _keys,
    _peers,
    _queues,
    _topics,
    _computer,
)
