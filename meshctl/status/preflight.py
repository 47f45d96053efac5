"""Go or no-go: the questions a team asks before robots drive off, each answered with its reason.

`preflight` asks all of them, in the order in which a team would mend what is wrong: the base, the radios, the robots'
computers, what the daemons tell of each other, and last whether urgent messages really get through.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

from meshctl.model import Fleet, NodeState, Role
from meshctl.status.node_alarms import join_limited
from meshctl.status.pings import Pings
from meshctl.status.robots import is_active
from meshctl.status.topics import is_urgent
from meshctl.status.values import Alarm, FleetStatus, Health, Level, NodeStatus, RobotStatus

# More reasons than this make a line that nobody reads; `meshctl status` has them all.
MAX_REASONS = 4
# the check that stands for all of the robots' computers where they were not asked
ROBOTS = "robots"


@dataclass(frozen=True, slots=True)
class Check:
    """One line: what was asked, whether it is a go, and why.

    An unchecked item does not block the run, and is not shown as `go`.
    """

    name: str
    is_go: bool
    reason: str
    is_checked: bool = True


def preflight(fleet: Fleet, status: FleetStatus, pings: Pings | None = None) -> tuple[Check, ...]:
    """Every check. `pings` None means that no robot was asked to send any."""
    checks = [check(fleet, status) for check in _CHECKS]
    if any(robot.computer is not None for robot in fleet.robots.values()) and not _skipped_reason(status):
        checks += [check(fleet, status) for check in _ROBOT_CHECKS]
        checks.append(_delivery(fleet, status, pings or Pings()))
    elif _skipped_reason(status):
        checks.append(Check(ROBOTS, True, _skipped_reason(status), is_checked=False))
    return tuple(checks)


def verdict(checks: Iterable[Check]) -> str:
    """`GO`, `GO (radios only)`, `GO (not checked: links)`, or `NO-GO`."""
    listed = tuple(checks)
    if not all(check.is_go for check in listed):
        return "NO-GO"
    left_out = [check.name for check in listed if not check.is_checked]
    if left_out == [ROBOTS]:
        return "GO (radios only)"
    return f"GO (not checked: {', '.join(left_out)})" if left_out else "GO"


def _skipped_reason(status: FleetStatus) -> str:
    return next((alarm.text for alarm in status.alarms if alarm.code == "robots-unasked"), "")


def _check(name: str, bad: Iterable[str], good: str, asked: tuple[int, int] | None = None) -> Check:
    """A go with the reason `good` unless something is `bad`. `asked` is how many of how many gave an answer: where
    nobody did, nothing is known, which is no go."""
    told = list(bad)
    if asked is not None and not told:
        answered, count = asked
        if not answered:
            return Check(name, False, "nobody answers who could tell")
        good += f" ({answered} of {count} tell)" if answered < count else ""
    more = f"; and {len(told) - MAX_REASONS} more" if len(told) > MAX_REASONS else ""
    return Check(name, not told, "; ".join(told[:MAX_REASONS]) + more if told else good)


def _answered(devices: Sequence[NodeStatus | RobotStatus]) -> tuple[int, int]:
    """How many answered, of those who are on or should be."""
    expected = [one for one in devices if one.health is not Health.OFF]
    return sum(not one.no_answer_reason for one in expected), len(expected)


def _answered_daemons(status: FleetStatus) -> tuple[int, int]:
    """How many daemons answered, of those that take part."""
    crew = _active_robots(status)
    return sum(robot.facts is not None and robot.facts.answers for robot in crew), len(crew)


def _plural(count: int, what: str) -> str:
    return f"{count} {what}{'' if count == 1 else 's'}"


def _alarm_check(
    name: str, good: str, *codes: str, robots: bool = False, daemons: bool = False, is_fleetwide: bool = False
) -> Callable[[Fleet, FleetStatus], Check]:
    """A check that nobody has one of these alarms; `daemons` when only a robot's daemon could tell."""

    def check(fleet: Fleet, status: FleetStatus) -> Check:
        devices: Sequence[NodeStatus | RobotStatus] = status.robots if robots or daemons else status.nodes
        asked = _answered_daemons(status) if daemons else _answered(devices)
        bad = [_alarm_text(one.name, one.alarms, codes) for one in devices]
        everywhere = [alarm.text for alarm in status.alarms if is_fleetwide and alarm.code in codes]
        return _check(name, [*everywhere, *(text for text in bad if text)], good, asked)

    return check


def _alarm_text(name: str, alarms: Iterable[Alarm], codes: Iterable[str]) -> str:
    """What a note says stops nobody."""
    found = ", ".join(alarm.text for alarm in alarms if alarm.code in codes and alarm.level > Level.NOTE)
    return f"{name}: {found}" if found else ""


def _base_answers(fleet: Fleet, status: FleetStatus) -> Check:
    base = fleet.base_node
    if base is None:
        return Check("base", False, "the inventory has no base")
    found = next((node for node in status.nodes if node.name == base.name), None)
    is_there = found is not None and not found.no_answer_reason
    why = f": {found.no_answer_reason}" if found is not None and found.no_answer_reason else ""
    return Check("base", is_there, f"{base.name} answers" if is_there else f"{base.name} does not answer{why}")


def _robot_radios(fleet: Fleet, status: FleetStatus) -> Check:
    """Those deployed must answer; a robot on the shelf is named, so that nobody forgets it there."""
    radios = [node for node in status.nodes if node.node.role is Role.ROBOT]
    deployed = [node for node in radios if node.node.state is NodeState.DEPLOYED]
    shelved = [f"{node.name} ({node.node.state.value})" for node in radios if node.node.state is not NodeState.DEPLOYED]
    good = f"{_plural(len(deployed), 'robot radio')} answer{'s' if len(deployed) == 1 else ''}" if radios else "none"
    good += f"; not taking part: {join_limited(tuple(shelved))}" if shelved else ""
    return _check("robot radios", [_no_answer_text(node) for node in deployed if node.no_answer_reason], good)


def _beacons(fleet: Fleet, status: FleetStatus) -> Check:
    """Those in a rack must have been seen once, those deployed must answer now."""
    states = (NodeState.CARRIED, NodeState.DEPLOYED)
    beacons = [node for node in status.nodes if node.node.role is Role.BEACON and node.node.state in states]
    unknown = [node for node in beacons if node.age_s is None and node.no_answer_reason]
    missed = [node for node in beacons if node.health is Health.UNREACHABLE and node not in unknown]
    told = (
        [f"{join_limited(tuple(n.name for n in unknown))}: never seen; switch on once before it is packed"]
        if unknown
        else []
    )
    on = sum(not node.no_answer_reason for node in beacons)
    good = f"{_plural(len(beacons), 'beacon')} known, {on} on" if beacons else "none"
    return _check("beacons", [*told, *(_no_answer_text(node) for node in missed)], good)


def _no_answer_text(one: NodeStatus | RobotStatus) -> str:
    return f"{one.name}: {one.no_answer_reason}"


def _quality(fleet: Fleet, status: FleetStatus) -> Check:
    deployed = [node for node in status.nodes if node.hops and node.quality is not None]
    weak = [text for node in status.nodes if (text := _alarm_text(node.name, node.alarms, ("no-path", "weak")))]
    worst = min((node.quality for node in deployed if node.quality is not None), default=None)
    good = "no path to measure" if worst is None else f"every path carries, the weakest {worst:.0%}"
    found = _check("links", weak, good, _answered(status.nodes))
    has_paths = any(node.node.role is not Role.BASE for node in status.nodes if node.health is not Health.OFF)
    return replace(found, is_checked=False) if found.is_go and worst is None and has_paths else found


def _strangers(fleet: Fleet, status: FleetStatus) -> Check:
    found = [f"{join_limited(status.strangers)} in the mesh"] if status.strangers else []
    return _check("strangers", found, "nobody else heard", _answered(status.nodes))


_CHECKS: Sequence[Callable[[Fleet, FleetStatus], Check]] = (
    _base_answers,
    _robot_radios,
    _beacons,
    _alarm_check(
        "identity", "every radio is the one it should be", "board", "host-key", "untrusted", "login", "failed"
    ),
    _alarm_check("firmware", "firmware and packages as in the inventory", "firmware", "packages"),
    _alarm_check(
        "configuration", "as in the inventory", "drift", "foreign", "refused", "not-compared", is_fleetwide=True
    ),
    _alarm_check("changes", "no change is under way", "change"),
    _alarm_check("radios", "every radio is in its cell", "radio", "join", "channel", "alone", "bridge"),
    _quality,
    _alarm_check("resources", "memory and flash suffice", "memory", "flash"),
    _strangers,
)


def _active_robots(status: FleetStatus) -> tuple[RobotStatus, ...]:
    """The robots that take part."""
    return tuple(robot for robot in status.robots if is_active(robot.state))


def _daemons(fleet: Fleet, status: FleetStatus) -> Check:
    """A daemon up on every robot that takes part."""
    codes = ("not-installed", "daemon", "unproven")
    bad = [
        _no_answer_text(r) if r.no_answer_reason else _alarm_text(r.name, r.alarms, codes)
        for r in _active_robots(status)
    ]
    without = [
        f"{name} {'has no computer' if robot.fielded is None else 'still runs the fielded program'}"
        for name, robot in fleet.robots.items()
        if robot.computer is None
    ]
    shelved = [robot.name for robot in status.robots if not is_active(robot.state)]
    good = f"{_plural(len(_active_robots(status)), 'daemon')} up"
    good += f"; not taking part: {join_limited(tuple(shelved))}" if shelved else ""
    good += f"; {', '.join(without)}" if without else ""
    return _check("daemons", [text for text in bad if text], good)


def _peers(fleet: Fleet, status: FleetStatus) -> Check:
    """Every robot's daemon hears every other's."""
    crew = [robot for robot in _active_robots(status) if robot.facts is not None and robot.facts.answers]
    names = [robot.name for robot in _active_robots(status)]
    bad = []
    for robot in crew:
        online = robot.facts.online if robot.facts is not None else ()
        missing = tuple(name for name in names if name not in online and name != robot.name)
        if missing:
            bad.append(f"{robot.name} does not hear {join_limited(missing)}")
    if not crew:
        bad.append("no daemon answers")
    return _check("peers", bad, f"every robot hears all {_plural(len(names) - 1, 'other')}")


def _urgent_topics(fleet: Fleet, status: FleetStatus) -> Check:
    """Emergency stops and commands are declared, with the inventory's priority, at every daemon."""
    urgent = [topic.name for topic in fleet.topics if is_urgent(topic)]
    if not urgent:
        return Check("urgent topics", False, "the inventory has no topic of class emergency_stop or command")
    bad = [
        f"{robot.name}: {topic.name} {topic.problem}"
        for robot in _active_robots(status)
        for topic in robot.topics
        if topic.name in urgent and topic.code == "undeclared"
    ]
    return _check("urgent topics", bad, f"{join_limited(tuple(urgent))} declared everywhere", _answered_daemons(status))


def _delivery(fleet: Fleet, status: FleetStatus, pings: Pings) -> Check:
    """A message through both daemons and back, from each robot to each other."""
    names = [robot.name for robot in _active_robots(status) if robot.facts is not None and robot.facts.answers]
    pairs = [(a, b) for a in names for b in names if a != b]
    bad = [
        f"{a} to {b}: {pings.failed.get((a, b), 'not tried')}" for a, b in pairs if (a, b) not in pings.round_trips_s
    ]
    if len(names) < 2:
        return Check("delivery", False, "fewer than two daemons answer: nothing can be sent")
    worst = max(pings.round_trips_s.items(), key=lambda pair: pair[1], default=None)
    slowest = "" if worst is None else f", the slowest {worst[0][0]} to {worst[0][1]} in {worst[1] * 1000:.0f} ms"
    return _check("delivery", bad, f"urgent messages arrive between all {_plural(len(pairs), 'pair')}{slowest}")


_ROBOT_CHECKS: Sequence[Callable[[Fleet, FleetStatus], Check]] = (
    _daemons,
    _alarm_check("one release", "the same version and configuration", "drift", "version", robots=True),
    _alarm_check("keys", "all open what all seal", "key", "unkeyed", daemons=True),
    _alarm_check("ROS bridges", "up where one belongs", "ros-bridge", robots=True),
    _peers,
    _urgent_topics,
    _alarm_check("queues", "no urgent message waits", "urgent-queue", "restarts", daemons=True),
    _alarm_check("topics", "every topic flows", "topic-undeclared", "topic-silent", "topic-not-arriving", daemons=True),
    _alarm_check("computers", "disk, memory and clock allow it", "disk", "memory", "clock", robots=True),
)
