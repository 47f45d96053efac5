"""The go/no-go checks before a mission, each with its reason.

`preflight` runs them in the order in which problems are best fixed: base, radios, robots' computers, daemons and their
peers, and last the delivery of urgent messages.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

from meshctl.model import Fleet, NodeState, Role
from meshctl.status.alarm_codes import FORMER_DEVICE
from meshctl.status.emergency_stop import DELIVERED, StopResult
from meshctl.status.node_alarms import join_limited
from meshctl.status.pings import Pings
from meshctl.status.robots import is_active
from meshctl.status.topics import is_urgent
from meshctl.status.values import Alarm, FleetStatus, Health, Level, NodeStatus, RobotStatus
from meshctl.wording import counted

# `meshctl status` shows all of them.
MAX_REASONS = 4
# stands for all checks of robots when they were not queried
ROBOTS = "robots"
# stands for all checks of the devices that were not selected
OTHERS = "others"


@dataclass(frozen=True, slots=True)
class Check:
    """One check, its result and the reason.

    An item that was not checked does not block the mission, and is not shown as `go`.
    """

    name: str
    is_go: bool
    reason: str
    is_checked: bool = True


def preflight(
    fleet: Fleet,
    status: FleetStatus,
    pings: Pings | None = None,
    unselected: Sequence[str] = (),
    stop: StopResult | None = None,
) -> tuple[Check, ...]:
    """Run all checks.

    `pings` None: no test messages were sent; `unselected` are devices left out of `status`; `stop` is the result of a
    real emergency stop, None if the operator did not ask for one.
    """
    checks = [check(fleet, status) for check in _CHECKS]
    skipped = _skipped_reason(status)
    if unselected and not skipped and not _active_robots(status):
        skipped = "no robot is selected"
    if skipped:
        checks.append(Check(ROBOTS, True, skipped, is_checked=False))
    elif any(robot.computer is not None for robot in fleet.robots.values()):
        checks += [check(fleet, status) for check in _ROBOT_CHECKS]
        alone = bool(unselected) and len(_active_robots(status)) < 2
        checks.append(
            Check("delivery", True, "fewer than two robots are selected: no test messages", is_checked=False)
            if alone
            else _delivery(fleet, status, pings or Pings())
        )
    if stop is not None:
        checks.append(_emergency_stop(stop))
    if unselected:
        checks.append(Check(OTHERS, True, f"not selected: {join_limited(tuple(unselected))}", is_checked=False))
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


@dataclass(frozen=True, slots=True)
class _Answers:
    """How many devices can tell, of how many; `none` says what is missing if no device can."""

    count: int
    expected: int
    none: str


def _check(name: str, bad: Iterable[str], good: str, answers: _Answers | None = None) -> Check:
    """A go with the reason `good` unless something is `bad`. No answer at all is a no-go."""
    reasons = list(bad)
    if answers is not None and not reasons:
        if not answers.count:
            return Check(name, False, f"cannot check: {answers.none}")
        is_partial = answers.count < answers.expected
        good += f" ({answers.count} of {answers.expected} answer)" if is_partial else ""
    more = f"; and {len(reasons) - MAX_REASONS} more" if len(reasons) > MAX_REASONS else ""
    return Check(name, not reasons, "; ".join(reasons[:MAX_REASONS]) + more if reasons else good)


def _answered(devices: Sequence[NodeStatus | RobotStatus], none: str) -> _Answers:
    """Answers of the devices that are on or should be."""
    expected = [device for device in devices if device.health is not Health.OFF]
    return _Answers(sum(not device.no_answer_reason for device in expected), len(expected), none)


def _answered_radios(status: FleetStatus) -> _Answers:
    return _answered(status.nodes, "no radio answers")


def _answered_computers(status: FleetStatus) -> _Answers:
    return _answered(status.robots, "no computer answers")


def _installed(status: FleetStatus) -> _Answers:
    """The computers of active robots that answer and have udp_mesh."""
    robots = _active_robots(status)
    count = sum(robot.facts is not None and robot.facts.is_installed for robot in robots)
    none = "no computer has udp_mesh" if _answered_computers(status).count else "no computer answers"
    return _Answers(count, len(robots), none)


def _answered_daemons(status: FleetStatus) -> _Answers:
    """Answers of the daemons of active robots."""
    robots = _active_robots(status)
    count = sum(robot.facts is not None and robot.facts.answers for robot in robots)
    return _Answers(count, len(robots), "no daemon answers")


def _alarm_check(
    name: str,
    good: str,
    *codes: str,
    answered: Callable[[FleetStatus], _Answers] = _answered_radios,
    is_fleetwide: bool = False,
    with_notes: bool = False,
) -> Callable[[Fleet, FleetStatus], Check]:
    """A check that no device has one of these alarms, notes only if asked for; `answered` counts the devices that can
    report them."""
    least = Level.NOTE if with_notes else Level.WARNING

    def check(fleet: Fleet, status: FleetStatus) -> Check:
        devices: Sequence[NodeStatus | RobotStatus] = status.nodes if answered is _answered_radios else status.robots
        bad = [_alarm_text(device.name, device.alarms, codes, least) for device in devices]
        everywhere = [alarm.text for alarm in status.alarms if is_fleetwide and alarm.code in codes]
        return _check(name, [*everywhere, *(text for text in bad if text)], good, answered(status))

    return check


def _alarm_text(name: str, alarms: Iterable[Alarm], codes: Iterable[str], least: Level = Level.WARNING) -> str:
    """The texts of these alarms; notes do not block by default."""
    found = ", ".join(alarm.text for alarm in alarms if alarm.code in codes and alarm.level >= least)
    return f"{name}: {found}" if found else ""


def _base_answers(fleet: Fleet, status: FleetStatus) -> Check:
    """The base of each site that takes part."""
    if fleet.base_node is None:
        return Check("base", False, "the inventory has no base")
    found = {node.name: node for node in status.nodes}
    wanted = [base.name for node in status.nodes if (base := fleet.base_of(node.node)) is not None]
    names = tuple(dict.fromkeys(wanted or (fleet.base_node.name,)))
    reasons = {name: found[name].no_answer_reason if name in found else "" for name in names}
    missing = [
        f"{name} does not answer{f': {reasons[name]}' if reasons[name] else ''}"
        for name in names
        if name not in found or reasons[name]
    ]
    return Check("base", not missing, "; ".join(missing) or ", ".join(f"{name} answers" for name in names))


def _robot_radios(fleet: Fleet, status: FleetStatus) -> Check:
    """Deployed radios must answer; others are listed as not taking part, so that none is forgotten."""
    radios = [node for node in status.nodes if node.node.role is Role.ROBOT]
    deployed = [node for node in radios if node.node.state is NodeState.DEPLOYED]
    shelved = [f"{node.name} ({node.node.state.value})" for node in radios if node.node.state is not NodeState.DEPLOYED]
    verb = "answers" if len(deployed) == 1 else "answer"
    good = f"{counted(len(deployed), 'robot radio')} {verb}" if radios else "none"
    good += f"; not taking part: {join_limited(tuple(shelved))}" if shelved else ""
    return _check("robot radios", [_no_answer_text(node) for node in deployed if node.no_answer_reason], good)


def _beacons(fleet: Fleet, status: FleetStatus) -> Check:
    """Carried beacons must have been seen once, deployed ones must answer now."""
    states = (NodeState.CARRIED, NodeState.DEPLOYED)
    beacons = [node for node in status.nodes if node.node.role is Role.BEACON and node.node.state in states]
    unknown = [node for node in beacons if node.age_s is None and node.no_answer_reason]
    missed = [node for node in beacons if node.health is Health.UNREACHABLE and node not in unknown]
    never_seen = (
        [f"{join_limited(tuple(n.name for n in unknown))}: never seen; power it on once before packing"]
        if unknown
        else []
    )
    on = sum(not node.no_answer_reason for node in beacons)
    good = f"{counted(len(beacons), 'beacon')} known, {on} on" if beacons else "none"
    return _check("beacons", [*never_seen, *(_no_answer_text(node) for node in missed)], good)


def _no_answer_text(device: NodeStatus | RobotStatus) -> str:
    return f"{device.name}: {device.no_answer_reason}"


def _quality(fleet: Fleet, status: FleetStatus) -> Check:
    deployed = [node for node in status.nodes if node.hops and node.quality is not None]
    weak = [text for node in status.nodes if (text := _alarm_text(node.name, node.alarms, ("no-path", "weak")))]
    worst = min((node.quality for node in deployed if node.quality is not None), default=None)
    good = "no path to measure" if worst is None else f"all paths usable, the weakest has {worst:.0%}"
    found = _check("links", weak, good, _answered_radios(status))
    has_paths = any(node.node.role is not Role.BASE for node in status.nodes if node.health is not Health.OFF)
    return replace(found, is_checked=False) if found.is_go and worst is None and has_paths else found


def _strangers(fleet: Fleet, status: FleetStatus) -> Check:
    found = [f"{join_limited(status.strangers)} in the mesh"] if status.strangers else []
    found += [alarm.text for alarm in status.alarms if alarm.code == FORMER_DEVICE]
    return _check("strangers", found, "none heard", _answered_radios(status))


_CHECKS: Sequence[Callable[[Fleet, FleetStatus], Check]] = (
    _base_answers,
    _robot_radios,
    _beacons,
    _alarm_check("identity", "every radio is the expected device", "board", "host-key", "untrusted", "login", "failed"),
    _alarm_check("firmware", "firmware and packages match the inventory", "firmware", "packages"),
    _alarm_check(
        "configuration", "matches the inventory", "drift", "foreign", "refused", "not-compared", is_fleetwide=True
    ),
    _alarm_check("changes", "no change in progress", "change", "locked", with_notes=True),
    _alarm_check("radios", "every radio is in its cell", "radio", "join", "left-over", "channel", "alone", "bridge"),
    _quality,
    _alarm_check("resources", "enough memory and flash", "memory", "flash"),
    _strangers,
)


def _active_robots(status: FleetStatus) -> tuple[RobotStatus, ...]:
    """The robots that take part."""
    return tuple(robot for robot in status.robots if is_active(robot.state))


def _daemons(fleet: Fleet, status: FleetStatus) -> Check:
    """The daemon of every active robot is up."""
    codes = ("not-installed", "daemon", "unproven")
    bad = [
        _no_answer_text(r) if r.no_answer_reason else _alarm_text(r.name, r.alarms, codes)
        for r in _active_robots(status)
    ]
    without = [
        f"{name} {'has no computer' if robot.fielded is None else 'still runs the legacy program'}"
        for name, robot in fleet.robots.items()
        if robot.computer is None
    ]
    shelved = [robot.name for robot in status.robots if not is_active(robot.state)]
    good = f"{counted(len(_active_robots(status)), 'daemon')} up"
    good += f"; not taking part: {join_limited(tuple(shelved))}" if shelved else ""
    good += f"; {', '.join(without)}" if without else ""
    return _check("daemons", [text for text in bad if text], good)


def _peers(fleet: Fleet, status: FleetStatus) -> Check:
    """Every daemon hears every other one."""
    answering = [robot for robot in _active_robots(status) if robot.facts is not None and robot.facts.answers]
    names = [robot.name for robot in _active_robots(status)]
    bad = []
    for robot in answering:
        online = robot.facts.online if robot.facts is not None else ()
        missing = tuple(name for name in names if name not in online and name != robot.name)
        if missing:
            bad.append(f"{robot.name} does not hear {join_limited(missing)}")
    if not answering:
        bad.append("no daemon answers")
    if not bad and len(names) < 2:
        return Check("peers", True, "fewer than two robots take part", is_checked=False)
    return _check("peers", bad, f"every robot hears all {counted(len(names) - 1, 'other')}")


def _urgent_topics(fleet: Fleet, status: FleetStatus) -> Check:
    """Every daemon has the emergency-stop and command topics with the inventory's priority."""
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
    """A test message from each robot to each other and back."""
    names = [robot.name for robot in _active_robots(status) if robot.facts is not None and robot.facts.answers]
    pairs = [(a, b) for a in names for b in names if a != b]
    bad = [f"{a} to {b}: {pings.failed.get((a, b), 'not sent')}" for a, b in pairs if (a, b) not in pings.round_trips_s]
    if len(names) < 2:
        return Check("delivery", False, "fewer than two daemons answer: cannot send test messages")
    worst = max(pings.round_trips_s.items(), key=lambda pair: pair[1], default=None)
    slowest = "" if worst is None else f", the slowest {worst[0][0]} to {worst[0][1]} in {worst[1] * 1000:.0f} ms"
    return _check("delivery", bad, f"urgent messages delivered between all {counted(len(pairs), 'pair')}{slowest}")


def _emergency_stop(stop: StopResult) -> Check:
    """A real emergency stop, acknowledged by every robot."""
    bad = [stop.problem] if stop.problem else []
    bad += [f"{name}: {outcome}" for name, outcome in stop.outcomes.items() if outcome != DELIVERED]
    if not bad and not stop.outcomes:
        bad = ["no robot to send it to"]
    return _check("emergency stop", bad, f"sent, and acknowledged by {join_limited(tuple(stop.outcomes))}")


_ROBOT_CHECKS: Sequence[Callable[[Fleet, FleetStatus], Check]] = (
    _daemons,
    _alarm_check("one release", "same version and configuration", "drift", "version", answered=_installed),
    _alarm_check("keys", "every robot can decrypt every other", "key", "unkeyed", answered=_answered_daemons),
    _alarm_check("ROS bridges", "up on every robot that has one", "ros-bridge", answered=_installed),
    _peers,
    _urgent_topics,
    _alarm_check("queues", "no urgent messages queued", "urgent-queue", "restarts", answered=_answered_daemons),
    _alarm_check(
        "topics",
        "every topic flows",
        "topic-undeclared",
        "topic-silent",
        "topic-not-arriving",
        answered=_answered_daemons,
    ),
    _alarm_check(
        "computers",
        "all answer; disk, memory and clock are fine",
        "computer-silent",
        "disk",
        "memory",
        "clock",
        answered=_answered_computers,
    ),
)
