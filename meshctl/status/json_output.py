"""The status as JSON. docs/status.md describes the schema; VERSION changes with it.

Times are in seconds, shares 0 to 1; an unknown value is null, never 0.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict
from typing import Any

from meshctl.robots.facts import RobotFacts
from meshctl.robots.position_facts import PositionFacts
from meshctl.status.last_known import typed
from meshctl.status.preflight import Check, verdict
from meshctl.status.values import Alarm, FleetStatus, Health, Level, Neighbor, NodeStatus, RadioStatus, RobotStatus
from meshctl.topology import Sighting

VERSION = 1


def as_json(status: FleetStatus) -> dict[str, Any]:
    """All facts, including those the table has no room for."""
    everywhere = [*status.alarms, *(alarm for device in status for alarm in device.alarms)]
    return {
        "version": VERSION,
        "fleet": status.fleet,
        "taken_s": round(status.taken_s, 3),
        "took_s": round(status.took_s, 3),
        "entry": status.entry,
        "exit_code": int(status.exit_code),
        "totals": {
            "nodes": {health.value: sum(node.health is health for node in status.nodes) for health in Health},
            "robots": {health.value: sum(robot.health is health for robot in status.robots) for health in Health},
            "alarms": {level.text: sum(alarm.level is level for alarm in everywhere) for level in Level},
        },
        "alarms": _alarms(status.alarms),
        "strangers": list(status.strangers),
        "nodes": [_node(node) for node in status.nodes],
        "robots": [_robot(robot) for robot in status.robots],
    }


def _alarms(alarms: Iterable[Alarm]) -> list[dict[str, str]]:
    return [{"level": a.level.text, "code": a.code, "text": a.text, "hint": a.hint} for a in alarms]


def _sightings(heard_by: Iterable[Sighting]) -> list[dict[str, Any]]:
    return [{"by": s.by, "age_s": s.age_ms / 1000, "signal_dbm": s.signal_dbm} for s in heard_by]


def _rounded(value: float | None, digits: int = 3) -> float | None:
    return None if value is None else round(value, digits)


def _node(node: NodeStatus) -> dict[str, Any]:
    answers = not node.no_answer_reason
    return {
        "name": node.name,
        "role": node.node.role.value,
        "state": node.node.state.value,
        "robot": node.node.robot or None,
        "address": str(node.node.address.ip),
        "health": node.health.value,
        "answers": answers,
        "silent_because": node.no_answer_reason or None,
        "age_s": _rounded(node.age_s),
        "alarms": _alarms(node.alarms),
        "version": node.version or None,
        "revision": node.revision or None,
        "drift": None if node.drift is None else list(node.drift),
        "uptime_s": node.uptime_s,
        "load": _rounded(node.load),
        "processors": node.processors,
        "memory_free": _rounded(node.memory_free),
        "flash_free_bytes": node.flash_free_bytes,
        "clock_offset_s": _rounded(node.clock_offset_s),
        "channels": list(node.channels) if answers else None,
        "tx_power_dbm": node.tx_power_dbm,
        "temperature_c": node.temperature_c,
        "radios": [_radio(radio) for radio in node.radios] if answers else None,
        "mesh_statistics": None
        if node.mesh_statistics is None
        else {name: dict(counters) for name, counters in node.mesh_statistics.items()},
        "mesh_tables": None
        if node.mesh_tables is None
        else {name: asdict(sizes) for name, sizes in node.mesh_tables.items()},
        "bridge_ports": None if node.lan_ports is None else list(node.lan_ports),
        "lan_filter": None if node.lan_filter is None else asdict(node.lan_filter),
        "neighbours": [_neighbor(neighbor) for neighbor in node.neighbors] if answers else None,
        "hops": node.hops,
        "quality": _rounded(node.quality),
        "via": node.via or None,
        "is_cut_vertex": node.is_cut_vertex if answers else None,
        "heard_by": _sightings(node.heard_by),
        "last_known": None if node.last_known is None else typed(node.last_known),
    }


def _neighbor(neighbor: Neighbor) -> dict[str, Any]:
    return {
        "name": neighbor.name,
        "mesh": neighbor.mesh or None,
        "age_s": neighbor.age_ms / 1000,
        "quality": _rounded(neighbor.quality),
        "signal_dbm": neighbor.signal_dbm,
        "chain_signals_dbm": list(neighbor.chain_signals_dbm) or None,
        "noise_dbm": neighbor.noise_dbm,
        "snr_db": neighbor.snr_db,
        "snr_there_db": neighbor.snr_there_db,
        "tx_mcs": neighbor.tx_mcs or None,
        "rx_mcs": neighbor.rx_mcs or None,
        "tx_bitrate_kbit_s": neighbor.tx_bitrate_kbit_s,
        "rx_bitrate_kbit_s": neighbor.rx_bitrate_kbit_s,
        "expected_kbit_s": neighbor.expected_kbit_s,
        "tx_packets": neighbor.tx_packets,
        "tx_retries": neighbor.tx_retries,
        "tx_failed": neighbor.tx_failed,
    }


def _radio(radio: RadioStatus) -> dict[str, Any]:
    return {
        "ifname": radio.ifname,
        "mesh": radio.mesh,
        "channel": radio.channel,
        "noise_dbm": radio.noise_dbm,
        "busy_ratio": _rounded(radio.busy_ratio),
        "busy_over_s": _rounded(radio.busy_over_s),
        "queue_packets": radio.queue_packets,
        "temperature_c": radio.temperature_c,
    }


def _position(place: PositionFacts) -> dict[str, Any]:
    return {
        "name": place.name,
        "x_m": _rounded(place.x_m),
        "y_m": _rounded(place.y_m),
        "z_m": _rounded(place.z_m),
        "frame": place.frame,
        "age_s": _rounded(place.age_s),
        "source": place.source,
    }


def _robot(robot: RobotStatus) -> dict[str, Any]:
    base = {
        "name": robot.name,
        "is_base": robot.robot.is_base,
        "state": None if robot.state is None else robot.state.value,
        "radios": list(robot.robot.nodes),
        "computers": [
            {
                "name": name,
                "address": str(of_robot.address.ip),
                "answers": _answers(robot.facts, str(of_robot.address.ip)),
            }
            for name, of_robot in robot.robot.computers.items()
        ],
        "address": None if robot.robot.computer is None else str(robot.robot.computer.address.ip),
        "health": robot.health.value,
        "answers": robot.facts is not None,
        "silent_because": robot.no_answer_reason or None,
        "age_s": _rounded(robot.age_s),
        "alarms": _alarms(robot.alarms),
        "heard_by": _sightings(robot.heard_by),
        "last_known": None if robot.last_known is None else typed(robot.last_known),
    }
    facts = robot.facts
    if facts is None:
        nothing = ("computer", "daemon", "bridge", "peers", "position", "positions", "queues", "topics")
        return {**base, **dict.fromkeys(nothing)}
    computer = facts.computer
    return {
        **base,
        "computer": {
            "uptime_s": computer.uptime_s,
            "load": None if computer.load is None else computer.load[0],
            "processors": computer.cpus or None,
            "memory_kib": computer.memory_kib or None,
            "memory_free_kib": computer.memory_free_kib if computer.memory_kib else None,
            "disk_kib": computer.disk_kib or None,
            "disk_free_kib": computer.disk_free_kib if computer.disk_kib else None,
            "clock_ahead_s": _rounded(computer.clock_ahead_s),
        },
        "daemon": {
            "answers": facts.answers,
            "service": facts.service.active or None,
            "enabled": facts.service.enabled or None,
            "restarts": facts.service.restarts,
            "version": facts.version or None,
            "release": facts.release or None,
            "previous": facts.previous or None,
            "is_proven": facts.is_proven,
            "drift": list(facts.drift) if robot.is_compared else None,
            "uptime_s": facts.daemon_uptime_s,
            "keys": list(facts.keys),
            "unkeyed": facts.unkeyed,
        },
        "bridge": None if facts.bridge is None else {"service": facts.bridge.active or None},
        "position": next((_position(position) for position in facts.positions if position.name == robot.name), None),
        "positions": [_position(position) for position in facts.positions],
        "peers": [
            {
                "name": peer.name,
                "online": peer.online,
                "heard_ago_s": _rounded(peer.heard_ago_s),
                "round_trip_s": _rounded(peer.round_trip_s, 6),
                "loss": _rounded(peer.loss),
                "outbox_messages": peer.outbox_messages,
                "outbox_bytes": peer.outbox_bytes,
                "capacity_bits_per_s": _rounded(peer.capacity_bits_per_s, 0),
                "delivered_bits_per_s": _rounded(peer.delivered_bits_per_s, 0),
                "via": list(peer.via),
            }
            for peer in facts.peers
        ],
        "queues": [
            {"priority": q.priority, "messages": q.messages, "bytes": q.bytes, "oldest_s": _rounded(q.oldest_s)}
            for q in facts.queues
        ],
        "topics": [
            {
                "name": topic.name,
                "priority": topic.priority,
                "sent_ago_s": _rounded(topic.sent_ago_s),
                "received_ago_s": _rounded(topic.received_ago_s),
                "limit_s": _rounded(topic.limit_s),
                "trouble": topic.problem or None,
            }
            for topic in robot.topics
        ],
    }


def _answers(facts: RobotFacts | None, address: str) -> bool | None:
    """Whether another computer of the robot answered; None if nothing pinged it."""
    return None if facts is None or facts.answering is None else address in facts.answering


def preflight_json(checks: Iterable[Check]) -> dict[str, Any]:
    """The overall `go` and each check."""
    listed = tuple(checks)
    return {
        "version": VERSION,
        "go": all(check.is_go for check in listed),
        "verdict": verdict(listed),
        "checks": [
            {"check": check.name, "go": check.is_go, "checked": check.is_checked, "reason": check.reason}
            for check in listed
        ],
    }
