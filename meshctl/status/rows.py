"""The cells of the status table: one row per radio and per robot's computer, under the same columns.

`row` gives the cells by column; last known facts of unreachable devices are in parentheses. Cells may have a short form
for narrow terminals.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from meshctl.inventory.selection import COMPUTER
from meshctl.report.duration import duration
from meshctl.status.robot_alarms import size
from meshctl.status.values import NodeStatus, RobotStatus
from meshctl.wording import counted


@dataclass(frozen=True, slots=True)
class TableCell:
    """`short` replaces `text` on narrow terminals."""

    text: str = ""
    short: str = ""

    @property
    def shortest(self) -> str:
        return self.short or self.text


@dataclass(frozen=True, slots=True)
class Column:
    """Columns with a higher `rank` are dropped first on a narrow terminal; 0 is never dropped."""

    key: str
    heading: str
    rank: int


# In display order; docs/status.md explains each.
COLUMNS = (
    Column("name", "name", 0),
    Column("what", "what", 3),
    Column("state", "state", 8),
    Column("health", "health", 0),
    Column("up", "up", 6),
    Column("load", "load", 12),
    Column("memory", "mem free", 11),
    Column("disk", "disk free", 14),
    Column("release", "release", 9),
    Column("config", "config", 5),
    Column("channel", "ch", 10),
    Column("bridge", "bridge", 15),
    Column("hears", "hears", 1),
    Column("path", "to base", 4),
    Column("via", "via", 13),
    Column("snr", "snr", 16),
    Column("mcs", "mcs", 18),
    Column("busy", "busy", 17),
    Column("waits", "waits", 7),
    Column("topics", "topics", 7),
    Column("age", "seen", 2),
)


def row(device: NodeStatus | RobotStatus) -> dict[str, TableCell]:
    """The cells of a device by column key."""
    return _node_row(device) if isinstance(device, NodeStatus) else _robot_row(device)


def _node_row(node: NodeStatus) -> dict[str, TableCell]:
    cells = {
        "name": TableCell(node.name),
        "what": TableCell(node.node.role.value),
        "state": TableCell(node.node.state.value),
        "health": TableCell(node.health.value),
        "age": TableCell(_age(node.age_s)),
    }
    if node.no_answer_reason:
        return cells | _bracketed(_known_node(node.last_known or {}))
    return cells | {
        "up": TableCell(_up(node.uptime_s)),
        "load": TableCell(_share(node.load)),
        "memory": TableCell(_share(node.memory_free)),
        "disk": TableCell("" if node.flash_free_bytes is None else size(node.flash_free_bytes / 1024)),
        "release": TableCell(node.version),
        "config": TableCell(_same(node.drift)),
        "channel": TableCell(",".join(map(str, node.channels))),
        "bridge": _bridge(node),
        "hears": _hears(node),
        "path": _path(node.hops, node.quality) if node.is_path_known else TableCell(),
        "via": TableCell(node.via),
        **_air(node),
    }


def _bridge(node: NodeStatus) -> TableCell:
    """The ports of its LAN bridge, and how many frames its LAN filter dropped: `eth0+bat0, 12 dropped`."""
    if node.lan_ports is None:
        return TableCell()
    ports = "+".join(node.lan_ports) or "nothing"
    if node.lan_filter is None:
        return TableCell(ports)
    return TableCell(f"{ports}, {node.lan_filter.dropped_packets} dropped", ports)


def _air(node: NodeStatus) -> dict[str, TableCell]:
    """SNR of the next hop as `here/there`, MCS as `to/from` it; the busiest channel, and the packets queued."""
    next_hop = node.next_hop
    busy = [radio.busy_ratio for radio in node.radios if radio.busy_ratio is not None]
    queued = [radio.queue_packets for radio in node.radios if radio.queue_packets is not None]
    cells = {
        "busy": TableCell(f"{max(busy):.0%}" if busy else ""),
        "waits": TableCell(str(sum(queued)) if queued else ""),
    }
    if next_hop is not None:
        if next_hop.worse_snr_db is not None:
            cells["snr"] = TableCell(f"{_or_unknown(next_hop.snr_db)}/{_or_unknown(next_hop.snr_there_db)} dB")
        if next_hop.tx_mcs or next_hop.rx_mcs:
            cells["mcs"] = TableCell(f"{_index(next_hop.tx_mcs)}/{_index(next_hop.rx_mcs)}")
    return cells


def _or_unknown(value: object) -> str:
    return "?" if value is None else str(value)


def _index(mcs: str) -> str:
    """`15` of `MCS 15`, `VHT 9` of `VHT-MCS 9 NSS 2`."""
    return mcs.split(" NSS", 1)[0].replace("-MCS", "").removeprefix("MCS ") or "?"


def _hears(node: NodeStatus) -> TableCell:
    """The number of nodes heard and the best one: `3: b01 -70 dBm 62%`."""
    count = str(len(node.neighbors))
    if not node.neighbors:
        return TableCell(count)
    best = node.neighbors[0]
    signal = "" if best.signal_dbm is None else f" {best.signal_dbm} dBm"
    quality = "" if best.quality is None else f" {best.quality:.0%}"
    return TableCell(f"{count}: {best.name}{signal}{quality}", count)


def _path(hops: int | None, quality: float | None) -> TableCell:
    if hops is None:
        return TableCell("no path", "none")
    if not hops:
        return TableCell("is base", "base")
    share = "" if quality is None else f" {quality:.0%}"
    return TableCell(f"{counted(hops, 'hop')}{share}", f"{hops}h{share}")


def _known_node(facts: Mapping[str, str]) -> dict[str, TableCell]:
    heard = facts.get("heard", "").split()
    hops = facts.get("hops", "")
    return {
        "release": TableCell(facts.get("version", "")),
        "config": TableCell(facts.get("config", "")),
        "channel": TableCell(facts.get("channels", "").replace(" ", ",")),
        "bridge": TableCell(facts.get("lan_ports", "").replace(" ", "+")),
        "hears": TableCell(", ".join(heard), str(len(heard)) if heard else ""),
        "path": TableCell(counted(int(hops), "hop") if hops else "", f"{hops}h" if hops else ""),
        "via": TableCell(facts.get("via", "")),
    }


def _robot_row(robot: RobotStatus) -> dict[str, TableCell]:
    cells = {
        "name": TableCell(robot.name),
        "what": TableCell(COMPUTER),
        "state": TableCell("" if robot.state is None else robot.state.value),
        "health": TableCell(robot.health.value),
        "age": TableCell(_age(robot.age_s)),
    }
    facts = robot.facts
    if facts is None:
        return cells | _bracketed(_known_robot(robot.last_known or {}))
    computer = facts.computer
    memory = computer.memory_free_kib / computer.memory_kib if computer.memory_kib else None
    cells |= {
        "up": TableCell(_up(computer.uptime_s)),
        "load": TableCell(_share(computer.load[0] / computer.cpus if computer.load and computer.cpus else None)),
        "memory": TableCell(_share(memory)),
        "disk": TableCell(size(computer.disk_free_kib) if computer.disk_kib else ""),
        "release": TableCell(facts.version or ("installed" if facts.release else "none")),
        "config": TableCell(_same(facts.drift) if robot.is_compared else ""),
        "bridge": TableCell("" if facts.bridge is None else f"ROS {facts.bridge.active or 'absent'}"),
    }
    if not facts.answers:
        return cells | {"hears": TableCell("no daemon", "none")}
    waiting = [queue for queue in facts.queues if queue.messages]
    by_priority = " ".join(f"{queue.priority}:{queue.messages}" for queue in waiting)
    messages = sum(queue.messages for queue in waiting)
    bad = sum(bool(topic.problem) for topic in robot.topics)
    peers = f"{len(facts.online)} of {len(facts.peers)}"
    relayed = f", {len(facts.reached_through)} relayed" if facts.reached_through else ""
    return cells | {
        "hears": TableCell(f"{peers} daemons{relayed}", peers),
        "path": TableCell("" if robot.base_round_trip_s is None else f"{robot.base_round_trip_s * 1000:.0f} ms"),
        "waits": TableCell(by_priority or "0", str(messages)),
        "topics": TableCell(f"{bad} of {len(robot.topics)} bad" if bad else "ok" if robot.topics else ""),
    }


def _known_robot(facts: Mapping[str, str]) -> dict[str, TableCell]:
    online = facts.get("online", "").split()
    return {
        "release": TableCell(facts.get("version", "")),
        "config": TableCell(facts.get("config", "")),
        "hears": TableCell(", ".join(online), str(len(online)) if online else ""),
    }


def _bracketed(cells: Mapping[str, TableCell]) -> dict[str, TableCell]:
    """Cells of last known facts, in parentheses."""
    return {
        key: TableCell(f"({cell.text})", f"({cell.short})" if cell.short else "")
        for key, cell in cells.items()
        if cell.text
    }


def _up(uptime_s: float | None) -> str:
    return "" if uptime_s is None else duration(uptime_s)


def _age(age_s: float | None) -> str:
    return "never" if age_s is None else duration(age_s)


def _share(value: float | None) -> str:
    return "" if value is None else f"{value:.0%}"


def _same(drift: tuple[str, ...] | None) -> str:
    return "" if drift is None else "differs" if drift else "same"
