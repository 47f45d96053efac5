"""The status as text: totals, alarms with hints (most severe first), and one table of all devices.

The same alarm on many devices is one line. The caller gives the terminal's width and colors.
"""

from __future__ import annotations

import textwrap
import time
from collections.abc import Iterable, Iterator, Sequence

from meshctl.errors import ExitCode
from meshctl.inventory.selection import COMPUTER
from meshctl.report.duration import duration
from meshctl.report.line_wrap import wrap
from meshctl.report.terminal_escapes import one_line
from meshctl.status.node_alarms import join_limited
from meshctl.status.preflight import Check, verdict
from meshctl.status.rows import row
from meshctl.status.table import Paint, plain, table_lines
from meshctl.status.values import Alarm, FleetStatus, Health, Level, NodeStatus, RobotStatus, stranger_alarm
from meshctl.wording import counted

# More devices than this with the same alarm share one line.
MAX_SINGLE_ALARMS = 3
# After a longer table the verdict is repeated, since the first one has scrolled off the screen.
MAX_SCREEN_ROWS = 20
# Minimum width of the text beside a label.
_MIN_WIDTH = 20
_VERDICTS = {
    ExitCode.OK: ("all well", "ok"),
    ExitCode.FINDINGS: ("DEGRADED", "degraded"),
    ExitCode.UNREACHABLE: ("UNREACHABLE", "unreachable"),
}


def text(
    status: FleetStatus,
    width: int | None = None,
    paint: Paint = plain,
    *,
    topics: bool = False,
    brief: bool = False,
) -> str:
    """All of it, wrapped at `width` (None: not wrapped). `topics` adds one line per topic and robot; `brief` leaves out
    notes and hints."""
    devices = list(status)
    lines = [*summary_lines(status, width, paint, brief=brief), ""]
    lines += table_lines([row(device) for device in devices], width, paint) or ["no device matches"]
    if topics:
        lines += ["", *topic_lines(status, width)]
    if len(devices) > MAX_SCREEN_ROWS:
        lines += ["", *_verdict_lines(status, width, paint)]
    return "\n".join(lines)


def summary_lines(
    status: FleetStatus, width: int | None = None, paint: Paint = plain, *, brief: bool = False
) -> list[str]:
    """The verdict, the totals and the alarms."""
    lines = _verdict_lines(status, width, paint)
    for total in _totals(status):
        lines += wrap(f"  {total}", width)
    alarms = list(_alarm_lines(status, width, paint, brief))
    return [*lines, "", *alarms] if alarms else lines


def verdict_line(status: FleetStatus, paint: Paint = plain) -> str:
    """`lab: DEGRADED: 1 error, 2 warnings (23:45:12 UTC, took 1.2 s)`."""
    word, style = _VERDICTS[status.exit_code]
    counts = {level: sum(alarm.level is level for _, alarm in _all_alarms(status)) for level in reversed(Level)}
    parts = [counted(count, level.text) for level, count in counts.items() if count]
    when = time.strftime("%H:%M:%S UTC", time.gmtime(status.taken_s))
    took = f", took {status.took_s:.1f} s" if status.took_s else ""
    return f"{status.fleet}: {paint(word, style)}{': ' if parts else ''}{', '.join(parts)} ({when}{took})"


def _verdict_lines(status: FleetStatus, width: int | None, paint: Paint) -> list[str]:
    """`verdict_line`, wrapped."""
    if width is None or len(verdict_line(status)) <= width:
        return [verdict_line(status, paint)]
    word, style = _VERDICTS[status.exit_code]
    first, *others = wrap(verdict_line(status), width)
    return [first.replace(word, paint(word, style), 1), *others]


def _totals(status: FleetStatus) -> Iterator[str]:
    groups: tuple[tuple[str, Sequence[NodeStatus | RobotStatus]], ...] = (
        ("radio", status.nodes),
        (COMPUTER, status.robots),
    )
    for what, devices in groups:
        if devices:
            counts = [(health, sum(device.health is health for device in devices)) for health in Health]
            text = ", ".join(f"{count} {health.value}" for health, count in counts if count)
            yield f"{counted(len(devices), what)}: {text}"


def _all_alarms(status: FleetStatus) -> list[tuple[str, Alarm]]:
    """(device, alarm), most severe first; the device is empty for alarms of the fleet."""
    found = [("", alarm) for alarm in status.alarms]
    if status.strangers:
        found.append(("", stranger_alarm(status)))
    for device in status:
        found += [(device.title, alarm) for alarm in device.alarms]
    return sorted(found, key=lambda pair: -pair[1].level)


def _alarm_lines(status: FleetStatus, width: int | None, paint: Paint, brief: bool) -> Iterator[str]:
    groups: dict[tuple[Level, str, bool], list[tuple[str, Alarm]]] = {}
    for name, alarm in _all_alarms(status):
        groups.setdefault((alarm.level, alarm.code, bool(name)), []).append((name, alarm))
    for (level, code, is_of_device), members in groups.items():
        if brief and level is Level.NOTE:
            continue
        lead = level.text.upper().ljust(7)
        if is_of_device and len(members) > MAX_SINGLE_ALARMS:
            names = join_limited(tuple(name for name, _ in members))
            text = f"{code} on {len(members)}: {names} (details: --alarm {code})"
            yield from _wrapped(lead, text, width, paint, level.text)
            continue
        for name, alarm in members:
            yield from _wrapped(lead, f"{name}: {alarm.text}" if name else alarm.text, width, paint, level.text)
            if alarm.hint and level > Level.NOTE and not brief:
                yield from _wrapped("       ", f"-> {alarm.hint}", width, paint, "")


def _wrapped(lead: str, text: str, width: int | None, paint: Paint, style: str) -> Iterator[str]:
    """`lead` in its style, then the text, wrapped."""
    first, *others = _wrap_after(f"{lead} ", text, width, "   " if text.startswith("-> ") else "")
    yield f"{paint(lead, style)}{first[len(lead) :]}"
    yield from others


def _wrap_after(lead: str, text: str, width: int | None, indent: str = "") -> list[str]:
    """The text wrapped after `lead`, with later lines `indent`ed further; below it if there is no room."""
    lead, text = one_line(lead), one_line(text)
    if width is None:
        return [f"{lead}{text}"]
    if text and width - len(lead) < min(_MIN_WIDTH, len(text)):
        return [lead.rstrip(), *textwrap.wrap(text, width, initial_indent="  ", subsequent_indent="  ")]
    parts = textwrap.wrap(text, max(width - len(lead), 1), subsequent_indent=indent, break_on_hyphens=False)
    first, *others = parts or [""]
    return [f"{lead}{first}", *(f"{' ' * len(lead)}{part}" for part in others)]


def topic_lines(status: FleetStatus, width: int | None = None) -> list[str]:
    """One row per topic and robot: when it was last sent and received, and what is wrong."""
    rows = [("topic", "priority", COMPUTER, "sent", "received", "")]
    for robot in status.robots:
        for topic in robot.topics:
            rows.append(
                (
                    topic.name,
                    "-" if topic.priority is None else str(topic.priority),
                    robot.name,
                    _ago(topic.sent_ago_s),
                    _ago(topic.received_ago_s),
                    topic.problem,
                )
            )
    rows = [rows[0], *sorted(rows[1:], key=lambda cells: (cells[1] == "-", cells[1].rjust(3), cells[0]))]
    widths = [max(len(cells[column]) for cells in rows) + 2 for column in range(len(rows[0]) - 1)]
    for least in (rows[0].index("priority"), rows[0].index("sent")):
        if width is not None and sum(widths) > width + 2:
            widths[least] = 0
    lines = []
    for *cells, problem in rows:
        lead = "".join(cell.ljust(room) for cell, room in zip(cells, widths, strict=True) if room)
        lines += [line.rstrip() for line in _wrap_after(lead, problem, width)]
    return lines


def _ago(age_s: float | None) -> str:
    return "-" if age_s is None else f"{duration(age_s)} ago"


def preflight_text(checks: Iterable[Check], width: int | None = None, paint: Paint = plain) -> str:
    """One line per check (`go`, `NO-GO`, `?` for not checked), then the verdict."""
    listed: Sequence[Check] = tuple(checks)
    room = max((len(check.name) for check in listed), default=0)
    lines = []
    for check in listed:
        word, style = _mark(check)
        first, *others = _wrap_after(f"{word}  {check.name.ljust(room)}  ", check.reason, width)
        lines += [f"{paint(word, style)}{first[len(word) :]}", *others]
    failed = [check.name for check in listed if not check.is_go]
    if failed:
        lines += _wrapped("NO-GO:", ", ".join(failed), width, paint, "error")
    else:
        is_whole = all(check.is_checked for check in listed)
        lines.append(paint(verdict(listed), "ok" if is_whole else "warning"))
    return "\n".join(lines)


def _mark(check: Check) -> tuple[str, str]:
    """The label of a check, and its style."""
    if not check.is_go:
        return "NO-GO", "error"
    return ("go   ", "ok") if check.is_checked else ("?    ", "warning")
