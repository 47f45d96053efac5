"""What is kept of a status for the day when a device is silent: status -> facts -> journal -> what was last known.

The journal keeps one text per fact and device. Radios are kept as `status.NAME`, beside what every command keeps of
them under NAME; robots as `robot.NAME`. `remembered` joins both, the newer winning.
"""

from __future__ import annotations

from collections.abc import Mapping

from meshctl.fleet.journal import LastKnown
from meshctl.status.values import FleetStatus, NodeStatus, RobotStatus

NODE_PREFIX = "status."
ROBOT_PREFIX = "robot."
# As many neighbours as help to find a node again.
_NEIGHBOURS_KEPT = 4
_INTEGERS = frozenset({"hops", "flash_free_bytes", "restarts", "urgent_bytes", "disk_free_kib"})
_NUMBERS = frozenset({"uptime_s", "load", "memory_free", "quality", "clock_offset_s"})
_LISTS = frozenset({"macs", "neighbours", "heard", "channels", "lan_ports", "online", "relays"})


def facts_to_record(status: FleetStatus) -> dict[str, dict[str, str]]:
    """By the journal's name: what everybody who answered told."""
    kept = {f"{NODE_PREFIX}{node.name}": node_facts(node) for node in status.nodes if not node.no_answer_reason}
    kept |= {f"{ROBOT_PREFIX}{robot.name}": robot_facts(robot) for robot in status.robots if robot.facts is not None}
    return kept


def node_facts(node: NodeStatus) -> dict[str, str]:
    """What is worth knowing of a radio that is gone."""
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
        "heard": " ".join(neighbour.name for neighbour in node.neighbors[:_NEIGHBOURS_KEPT]),
    }
    return {name: value for name, value in facts.items() if value}


def robot_facts(robot: RobotStatus) -> dict[str, str]:
    """What is worth knowing of a robot that is gone, and what the next look compares with."""
    told = robot.facts
    if told is None:
        return {}
    computer = told.computer
    facts = {
        "version": told.version,
        "release": told.release,
        "config": "differs" if told.drift else "same",
        "service": told.service.active,
        "uptime_s": _number(computer.uptime_s),
        "memory_free": _number(computer.memory_free_kib / computer.memory_kib if computer.memory_kib else None),
        "disk_free_kib": _number(computer.disk_free_kib if computer.disk_kib else None),
        "online": " ".join(told.online),
        "restarts": _number(told.service.restarts),
        "urgent_bytes": _number(robot.urgent_bytes),
    }
    return {name: value for name, value in facts.items() if value}


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:d}" if isinstance(value, int) else f"{value:.4g}"


def merge_by_device(known: Mapping[str, LastKnown]) -> dict[str, LastKnown]:
    """By node, and by `robot.NAME`: everything kept of it, with the time of the latest sighting."""
    found: dict[str, LastKnown] = {}
    for key, last in known.items():
        name = key.removeprefix(NODE_PREFIX)
        other = found.get(name)
        if other is None:
            found[name] = LastKnown(name, last.seen_s, last.facts)
        else:
            older, newer = sorted((other, last), key=lambda one: one.seen_s)
            found[name] = LastKnown(name, newer.seen_s, {**older.facts, **newer.facts})
    return found


def typed(facts: Mapping[str, str]) -> dict[str, object]:
    """The facts for programs: numbers as numbers, lists as lists."""
    told: dict[str, object] = {}
    for name, text in facts.items():
        if name in _LISTS:
            told[name] = text.split()
        elif name in _INTEGERS | _NUMBERS:
            told[name] = _parsed(text, whole=name in _INTEGERS)
        else:
            told[name] = text
    return told


def _parsed(text: str, *, whole: bool) -> float | None:
    """None for what an older or newer meshctl wrote in another form."""
    try:
        return int(text) if whole else float(text)
    except ValueError:
        return None
