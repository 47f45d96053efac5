"""The status for people: one table, then what is wrong, worst first. Plain text; the caller colours or pages it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from meshctl.status.alarms import duration
from meshctl.status.preflight import Check
from meshctl.status.values import FleetStatus, Health, NodeStatus

_HEADINGS = ("node", "role", "state", "health", "up", "release", "config", "ch", "neighbours", "hops", "quality", "age")


def table(status: FleetStatus) -> str:
    """Columns as wide as they must be."""
    rows = [_HEADINGS, *(_row(node) for node in status.nodes)]
    widths = [max(len(row[column]) for row in rows) for column in range(len(_HEADINGS))]
    return "\n".join(
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows
    )


def _row(node: NodeStatus) -> tuple[str, ...]:
    first = node.neighbours[0] if node.neighbours else None
    neighbours = str(len(node.neighbours))
    if first is not None:
        best = f"{first.signal_dbm} dBm" if first.signal_dbm is not None else ""
        best = best or (f"{first.quality:.0%}" if first.quality is not None else "")
        neighbours += f" ({first.name}{' ' + best if best else ''})"
    answers = node.health in (Health.OK, Health.DEGRADED) and not node.silent_because
    return (
        node.name,
        node.node.role.value,
        node.node.state.value,
        node.health.value,
        duration(node.uptime_s) if node.uptime_s is not None else "-",
        node.version or "-",
        "-" if node.drift is None else "differs" if node.drift else "same",
        ",".join(map(str, node.channels)) or "-",
        neighbours if answers else "-",
        "-" if node.hops is None else str(node.hops),
        "-" if node.quality is None else f"{node.quality:.0%}",
        "never" if node.age_s is None else duration(node.age_s),
    )


def text(status: FleetStatus) -> str:
    """The table, the alarms, and one line of totals."""
    lines = [table(status), ""]
    found = [(alarm, node.name) for node in status.nodes for alarm in node.alarms]
    for alarm, name in sorted(found, key=lambda pair: -pair[0].level):
        lines.append(f"{alarm.level.text}: {name}: {alarm.text}")
    lines += [f"warning: {mac} is in the mesh and in no inventory" for mac in status.strangers]
    counted = (f"{count} {health.value}" for health in Health if (count := status.count(health)))
    lines.append(f"{status.fleet}: {', '.join(counted) or 'no node'}")
    return "\n".join(lines)


def as_json(status: FleetStatus) -> dict[str, Any]:
    """The same for scripts; times in seconds, shares 0..1."""
    return {
        "fleet": status.fleet,
        "taken": status.taken_s,
        "entry": status.entry,
        "exit_code": int(status.exit_code),
        "totals": {health.value: status.count(health) for health in Health},
        "strangers": list(status.strangers),
        "nodes": [_node_json(node) for node in status.nodes],
    }


def _node_json(node: NodeStatus) -> dict[str, Any]:
    plain = (
        "age_s", "silent_because", "version", "revision", "uptime_s", "memory_free", "flash_free_bytes",
        "clock_offset_s", "tx_power_dbm", "hops", "quality", "via", "is_cut_vertex",
    )  # fmt: skip
    return {
        "name": node.name,
        "role": node.node.role.value,
        "state": node.node.state.value,
        "address": str(node.node.address),
        "health": node.health.value,
        "alarms": [{"level": a.level.text, "code": a.code, "text": a.text} for a in node.alarms],
        **{name: getattr(node, name) for name in plain},
        "drift": None if node.drift is None else list(node.drift),
        "channels": list(node.channels),
        "lan_ports": None if node.lan_ports is None else list(node.lan_ports),
        "neighbours": [
            {"name": n.name, "age_ms": n.age_ms, "quality": n.quality, "signal_dbm": n.signal_dbm}
            for n in node.neighbours
        ],
        "heard_by": [{"by": s.by, "age_ms": s.age_ms, "signal_dbm": s.signal_dbm} for s in node.heard_by],
        "last_known": None if node.last_known is None else dict(node.last_known),
    }


def preflight_text(checks: Iterable[Check]) -> str:
    """`GO` or `NO-GO`, one line per check."""
    listed: Sequence[Check] = tuple(checks)
    width = max((len(check.name) for check in listed), default=0)
    lines = [f"{'go   ' if check.is_go else 'NO-GO'}  {check.name.ljust(width)}  {check.reason}" for check in listed]
    verdict = "GO" if all(check.is_go for check in listed) else "NO-GO"
    return "\n".join([*lines, verdict])
