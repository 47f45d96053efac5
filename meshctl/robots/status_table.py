"""Text for people: `RobotFacts` -> a table; and what a deploy would change (`difference`). Pure."""

from __future__ import annotations

import sys
import textwrap
from collections.abc import Iterable

from meshctl.report.duration import duration
from meshctl.robots.bundle import UNIT_TITLES, Bundle
from meshctl.robots.facts import RobotFacts
from meshctl.robots.preconditions import HostFacts, changed_files

_HEADINGS = ("robot", "service", "release", "version", "up", "peers", "queued", "last message", "load", "keys")
# Dropped in this order on a narrow terminal; `--json` has all columns.
_DROP_ORDER = ("load", "release", "keys", "version", "last message", "up")
_GAP = "  "


def table(rows: Iterable[RobotFacts], width: int | None = None) -> str:
    """One line per robot: service, uptime, peers, queues, last message; below them what is wrong.

    Columns are dropped to fit `width`.
    """
    robots = list(rows)
    lines = [_HEADINGS, *(_row(robot) for robot in robots)]
    widths = {name: max(len(line[at]) for line in lines) for at, name in enumerate(_HEADINGS)}
    shown = list(_HEADINGS)
    for name in _DROP_ORDER:
        if width is None or sum(widths[column] + len(_GAP) for column in shown) - len(_GAP) <= width:
            break
        shown.remove(name)
    drawn = [
        _GAP.join(
            cell.ljust(widths[name]) for name, cell in zip(_HEADINGS, line, strict=True) if name in shown
        ).rstrip()
        for line in lines
    ]
    for robot in robots:
        if robot.error or robot.remark:
            drawn += textwrap.wrap(
                f"{robot.robot}: {robot.error or robot.remark}", width or sys.maxsize, subsequent_indent=_GAP
            )
        if robot.reached_through:
            relayed = f"{robot.robot}: reaches {', '.join(robot.reached_through)}"
            drawn += textwrap.wrap(relayed, width or sys.maxsize, subsequent_indent=_GAP)
    if len(shown) < len(_HEADINGS):
        left_out = ", ".join(name for name in _HEADINGS if name not in shown)
        drawn += textwrap.wrap(f"columns not shown: {left_out} (use --json)", width or sys.maxsize)
    return "\n".join(drawn)


def _row(facts: RobotFacts) -> tuple[str, ...]:
    if facts.error:
        return (facts.robot, "?", *["-"] * (len(_HEADINGS) - 2))
    load = facts.computer.load
    return (
        facts.robot,
        facts.service.active or "absent",
        facts.release or "-",
        facts.version or "-",
        "-" if facts.daemon_uptime_s is None else duration(facts.daemon_uptime_s),
        f"{len(facts.online)}/{len(facts.peers)}" if facts.answers else "-",
        _queued(facts) if facts.answers else "-",
        _last_message(facts),
        f"{load[0]:.1f}" if load else "-",
        "UNKEYED" if facts.unkeyed else " ".join(key[:8] for key in facts.keys) or "-",
    )


def _queued(facts: RobotFacts) -> str:
    """Queued messages by priority, most urgent first: `p0: 3, p9: 120`."""
    return ", ".join(f"p{queue.priority}: {queue.messages}" for queue in facts.queues if queue.messages) or "0"


def _last_message(facts: RobotFacts) -> str:
    ages = {topic.name: topic.last_ago_s for topic in facts.topics}
    heard = {name: age for name, age in ages.items() if age is not None}
    if not heard:
        return "-"
    name = min(heard, key=lambda each: heard[each])
    return f"{name} {duration(heard[name])} ago"


def difference(facts: HostFacts, release: Bundle) -> tuple[str, ...]:
    """One line per difference between a robot and the inventory; none if a deploy would do nothing.

    Files are named without a diff, since only their hashes are known.
    """
    if not facts.current:
        return (f"not installed; deploy would install {release.id}",)
    lines = [f"changed on the robot: {path}" for path in facts.damaged]
    lines += [f"differs from the inventory: {path}" for path in changed_files(facts, release.hashes)]
    if not facts.is_proven:
        lines.append("a switch was interrupted")
    for unit, active, enabled in facts.units:
        if active != "active":
            lines.append(f"{UNIT_TITLES[unit]} is {active or 'absent'}")
        if enabled != "enabled":
            lines.append(f"{UNIT_TITLES[unit]} is {enabled or 'absent'}: it will not start at boot")
    return tuple(lines)
