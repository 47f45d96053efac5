"""Last known facts of devices, to show when they are unreachable: status -> facts -> journal -> last known.

The journal stores one text per fact and device: radios as `status.NAME`, beside the facts that every command stores as
NAME, robots as `robot.NAME`. `merge_by_device` merges them; newer values win.
"""

from __future__ import annotations

from collections.abc import Mapping

from meshctl.fleet.journal import NODE_PREFIX, ROBOT_PREFIX, LastKnown
from meshctl.status.values import FleetStatus, NodeStatus, RobotStatus

# Enough neighbors to find a node again.
_MAX_NEIGHBORS = 4
_INTEGERS = frozenset({"hops", "flash_free_bytes", "restarts", "urgent_bytes", "disk_free_kib"})
_NUMBERS = frozenset({"uptime_s", "load", "memory_free", "quality", "clock_offset_s"})
_LISTS = frozenset({"macs", "neighbours", "heard", "channels", "lan_ports", "online", "relays"})


def facts_to_record(status: FleetStatus) -> dict[str, dict[str, str]]:
    """Facts of all devices that answered, by journal key."""
    kept = {f"{NODE_PREFIX}{node.name}": node_facts(node) for node in status.nodes if not node.no_answer_reason}
    kept |= {f"{ROBOT_PREFIX}{robot.name}": robot_facts(robot) for robot in status.robots if robot.facts is not None}
    return kept


def node_facts(node: NodeStatus) -> dict[str, str]:
    """The facts to record of a radio."""
    facts = {
        "version": node.version,
        "revision": node.revision,
        "config": "" if node.drift is None else "differs" if node.drift else "same",
        "uptime_s": _number(node.uptime_s),
        "load": _number(node.load),
        "memory_free": _number(node.memory_free),
        "flash_free_bytes": _number(node.flash_free_bytes),
        "channels": " ".join(map(str, node.channels)),
        "lan_ports": " ".join(node.lan_ports or ()),
        "hops": _number(node.hops),
        "quality": _number(node.quality),
        "via": node.via,
        "relays": " ".join(node.relays),
        "heard": " ".join(neighbor.name for neighbor in node.neighbors[:_MAX_NEIGHBORS]),
    }
    return {name: value for name, value in facts.items() if value}


def robot_facts(robot: RobotStatus) -> dict[str, str]:
    """The facts to record of a robot; the next snapshot compares with some of them."""
    observed = robot.facts
    if observed is None:
        return {}
    computer = observed.computer
    facts = {
        "version": observed.version,
        "release": observed.release,
        "config": "differs" if observed.drift else "same",
        "service": observed.service.active,
        "uptime_s": _number(computer.uptime_s),
        "memory_free": _number(computer.memory_free_kib / computer.memory_kib if computer.memory_kib else None),
        "disk_free_kib": _number(computer.disk_free_kib if computer.disk_kib else None),
        "online": " ".join(observed.online),
        "restarts": _number(observed.service.restarts),
        "urgent_bytes": _number(robot.urgent_bytes),
    }
    return {name: value for name, value in facts.items() if value}


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:d}" if isinstance(value, int) else f"{value:.4g}"


def merge_by_device(known: Mapping[str, LastKnown]) -> dict[str, LastKnown]:
    """All facts by node and by `robot.NAME`, with the time of the latest."""
    found: dict[str, LastKnown] = {}
    for key, last in known.items():
        name = key.removeprefix(NODE_PREFIX)
        other = found.get(name)
        if other is None:
            found[name] = LastKnown(name, last.seen_s, last.facts)
        else:
            older, newer = sorted((other, last), key=lambda record: record.seen_s)
            found[name] = LastKnown(name, newer.seen_s, {**older.facts, **newer.facts})
    return found


def typed(facts: Mapping[str, str]) -> dict[str, object]:
    """The facts as JSON values: numbers as numbers, lists as lists."""
    values: dict[str, object] = {}
    for name, text in facts.items():
        if name in _LISTS:
            values[name] = text.split()
        elif name in _INTEGERS | _NUMBERS:
            values[name] = _parsed(text, whole=name in _INTEGERS)
        else:
            values[name] = text
    return values


def _parsed(text: str, *, whole: bool) -> float | None:
    """None for a value in the format of another meshctl version."""
    try:
        return int(text) if whole else float(text)
    except ValueError:
        return None
