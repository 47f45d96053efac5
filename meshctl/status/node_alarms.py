"""What is wrong with a radio that answers: one small function per concern, each gives the alarms it sees.

A node's state decides what is expected of it: a carried beacon need not hear anybody, a deployed one must. Each alarm
says what to do about it, where there is something to do.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from meshctl.device.observation import Observation
from meshctl.model import Fleet, Node, NodeState, Role
from meshctl.plan import NodePlan, Verdict
from meshctl.status.values import Alarm, Level, Neighbor
from meshctl.topology import Path

# below this the path loses more than it carries: move a beacon
WEAK_QUALITY = 0.3
# below this a reload or an upgrade may be killed by the kernel
LOW_MEMORY_SHARE = 0.1
# the dead-man's switch keeps the previous state in flash: about this much with headroom
LOW_FLASH_BYTES = 256 * 1024
# a forwarding radio with this many processes waiting per processor answers late and drops frames
BUSY_LOAD = 4.0
# radios have no clock of their own and no NTP in a mine: only what breaks logs and certificates matters
CLOCK_TOLERANCE_S = 3600.0


# how iw names the modes that a mesh runs in
MESH_MODES = ("ibss", "mesh point")
MAX_NAMES = 6


@dataclass(frozen=True, slots=True)
class NodeAlarmInput:
    """Everything known about one node that answers."""

    fleet: Fleet
    node: Node
    observation: Observation
    plan: NodePlan | None
    neighbors: tuple[Neighbor, ...]
    path: Path | None
    is_path_known: bool
    """Whether enough was asked to tell its path."""
    cuts_off: tuple[str, ...]
    relays: tuple[str, ...]
    """Nodes whose path to the base leads through it."""
    seconds_since_last_known: float | None
    """Time between the last look, if any, and this one."""
    own_lock: str

    @property
    def must_mesh(self) -> bool:
        """Whether it should be part of its mesh now: deployed, and not the only one."""
        others = (n for mesh in self.node.meshes for n in self.fleet.members(mesh) if n.name != self.node.name)
        return self.node.state is NodeState.DEPLOYED and any(n.state is NodeState.DEPLOYED for n in others)


def alarms(seen: NodeAlarmInput) -> tuple[Alarm, ...]:
    """All alarms of a node, the worst first."""
    found = [alarm for concern in _CONCERNS for alarm in concern(seen)]
    return tuple(sorted(found, key=lambda alarm: -alarm.level))


def _identity(seen: NodeAlarmInput) -> Iterator[Alarm]:
    board = seen.observation.board
    if board is not None and board.board_name and board.board_name != seen.node.hardware.board:
        told = f"is a {board.board_name}, the inventory says {seen.node.hardware.board}"
        hint = f"another device answers there: look at its label, or mend nodes.{seen.node.name} in the inventory"
        yield Alarm(Level.ERROR, "board", told, hint)


def _drift(seen: NodeAlarmInput) -> Iterator[Alarm]:
    plan, name = seen.plan, seen.node.name
    if plan is None:
        return
    if plan.verdict is Verdict.REFUSED:
        yield Alarm(Level.ERROR, "refused", f"cannot be provisioned as it is: {plan.reason}", plan.hint)
    if plan.firmware is not None:
        told = f"firmware {plan.firmware.from_revision or 'unknown'}, the inventory says {plan.firmware.to_revision}"
        yield Alarm(Level.WARNING, "firmware", told, f"meshctl plan {name}, then meshctl provision {name}")
    if plan.packages is not None:
        told = f"packages missing: {', '.join(plan.packages.install)}"
        yield Alarm(Level.WARNING, "packages", told, f"meshctl provision {name}")
    if plan.files:
        names = ", ".join(change.path.removeprefix("etc/config/") for change in plan.files)
        hint = f"meshctl plan {name} shows how; meshctl provision {name} puts it right"
        yield Alarm(Level.WARNING, "drift", f"configuration differs: {names}", hint)


def _radios(seen: NodeAlarmInput) -> Iterator[Alarm]:
    wanted = {radio.name for radio in seen.node.radios if radio.mesh is not None}
    for radio in seen.observation.radios or ():
        if radio.name in wanted and (not radio.up or radio.setup_failed):
            why = "setup failed" if radio.setup_failed else "disabled" if radio.disabled else "down"
            hint = f"meshctl run {seen.node.name} -- logread -e netifd"
            yield Alarm(Level.ERROR, "radio", f"{radio.name} is {why}", hint)
    every = {seen.fleet.meshes[mesh].channel for mesh in seen.node.meshes}
    own = {name: {seen.fleet.meshes[mesh].channel} for name, mesh in seen.node.mesh_interfaces.items()}
    for link in seen.observation.links or ():
        if link.mode.upper() == "IBSS" and link.joined is False:
            hint = "look at channel, SSID, BSSID and key: meshctl topology shows who is in the cell"
            yield Alarm(Level.ERROR, "join", f"{link.ifname} has joined no cell", hint)
        # each radio of a relay has its own mesh; an interface of another name was not made by us
        channels = own.get(link.ifname, every)
        if link.mode.lower() in MESH_MODES and link.channel is not None and link.channel not in channels:
            told = f"{link.ifname} is on channel {link.channel}, its mesh on {', '.join(map(str, sorted(channels)))}"
            yield Alarm(Level.ERROR, "channel", told, f"meshctl plan {seen.node.name}")


def _mesh(seen: NodeAlarmInput) -> Iterator[Alarm]:
    if seen.must_mesh and not seen.neighbors:
        yield Alarm(Level.ERROR, "alone", "hears no other node", "antennas, distance, and whether its channel is free")
    elif seen.must_mesh and seen.path is None and seen.is_path_known:
        told = "no path through the mesh leads from it to the base"
        yield Alarm(Level.WARNING, "no-path", told, "which node between them is gone? meshctl topology")
    elif seen.path is not None and seen.path.hops and seen.path.quality < WEAK_QUALITY:
        hops = f"{seen.path.hops} hop{'s' if seen.path.hops > 1 else ''}"
        told = f"path to the base carries {seen.path.quality:.0%} over {hops}"
        yield Alarm(Level.WARNING, "weak", told, f"drop a beacon between {seen.node.name} and {seen.path.via}")
    if seen.cuts_off and seen.node.state is NodeState.DEPLOYED:
        yield Alarm(Level.NOTE, "cut-vertex", f"without it {join_limited(seen.cuts_off)} would be cut off")


def _dropped(seen: NodeAlarmInput) -> Iterator[Alarm]:
    """A beacon that the inventory has in a rack, and that others need where it is."""
    if seen.node.state is NodeState.CARRIED and seen.node.role is Role.BEACON and seen.relays:
        text = f"carried by the inventory, and the way from {join_limited(seen.relays)} to the base leads through it"
        yield Alarm(Level.NOTE, "dropped", text, f"if it has been dropped: meshctl deployed {seen.node.name}")


def _bridge(seen: NodeAlarmInput) -> Iterator[Alarm]:
    """A radio whose bridge lacks a LAN port, or the mesh, carries nothing for the computer beside it."""
    bridges = seen.observation.bridges
    if bridges is None or not seen.node.meshes:
        return
    joined = {port for bridge in bridges for port in bridge.ports}
    missing = [port for port in seen.node.lan_ports if port not in joined]
    if missing:
        level = Level.WARNING if seen.node.role is Role.BEACON else Level.ERROR
        told = f"no bridge joins {', '.join(missing)}: what is plugged in there is not in the mesh"
        yield Alarm(level, "bridge", told, f"meshctl plan {seen.node.name}")


def _resources(seen: NodeAlarmInput) -> Iterator[Alarm]:
    memory, flash, load = seen.observation.memory, seen.observation.overlay, seen.observation.load
    if memory is not None and memory.total and memory.available / memory.total < LOW_MEMORY_SHARE:
        told = f"{memory.available / 2**20:.1f} MiB of memory left"
        yield Alarm(Level.WARNING, "memory", told, "reboot it before anything is changed on it")
    if flash is not None and flash.free < LOW_FLASH_BYTES:
        hint = "remove packages or files: a change keeps the previous state there"
        yield Alarm(Level.WARNING, "flash", f"{flash.free // 1024} KiB of flash left", hint)
    if load is not None and load.minute / load.processors > BUSY_LOAD:
        told = f"load {load.minute:.1f} on {load.processors} processor{'s' if load.processors > 1 else ''}"
        yield Alarm(Level.NOTE, "load", told, f"meshctl run {seen.node.name} -- top -b -n 1")


def _changes(seen: NodeAlarmInput) -> Iterator[Alarm]:
    change = seen.observation.change
    if change is not None and change.state not in ("idle", "", "unknown", "absent"):
        left = "" if change.left_s is None else f", {change.left_s:.0f} s left"
        told = f"a change by {change.owner or 'somebody'} is {change.state}{left}"
        yield Alarm(Level.WARNING, "change", told, "wait until it is confirmed or has gone back")
    if change is not None and change.lock_owner and change.lock_owner != seen.own_lock:
        yield Alarm(Level.NOTE, "locked", f"locked by {change.lock_owner}")
    if seen.observation.uci_changes:
        count = len(seen.observation.uci_changes)
        told = f"{count} uncommitted UCI change{'s' if count > 1 else ''} by hand"
        hint = f"meshctl run {seen.node.name} -- uci changes; commit them into the inventory, or `uci revert` them"
        yield Alarm(Level.WARNING, "foreign", told, hint)


def _time(seen: NodeAlarmInput) -> Iterator[Alarm]:
    offset_s, uptime_s = seen.observation.clock_offset_s, seen.observation.uptime_s
    if offset_s is not None and abs(offset_s) > CLOCK_TOLERANCE_S:
        yield Alarm(Level.NOTE, "clock", f"its clock is off by {duration(abs(offset_s))}")
    since_s = seen.seconds_since_last_known
    if uptime_s is not None and since_s is not None and uptime_s < since_s:
        yield Alarm(Level.NOTE, "rebooted", f"rebooted {duration(uptime_s)} ago")


def join_limited(names: tuple[str, ...]) -> str:
    """The first names and how many more: a sentence stays a sentence in a fleet of hundreds."""
    if len(names) <= MAX_NAMES:
        return ", ".join(names)
    return f"{', '.join(names[:MAX_NAMES])} and {len(names) - MAX_NAMES} more"


_CONCERNS: tuple[Callable[[NodeAlarmInput], Iterator[Alarm]], ...] = (
    _identity,
    _drift,
    _radios,
    _mesh,
    _dropped,
    _bridge,
    _resources,
    _changes,
    _time,
)


def duration(seconds: float) -> str:
    """`4 s`, `12 min`, `3.5 h`, `2 d`, `3 years`: as short as a table's cell wants it."""
    for limit, unit_s, unit in ((120, 1, "s"), (7200, 60, "min"), (172800, 3600, "h"), (63072000, 86400, "d")):
        if seconds < limit:
            value = seconds / unit_s
            return f"{value:.1f} {unit}" if unit == "h" and value < 10 else f"{value:.0f} {unit}"
    return f"{seconds / 31536000:.0f} years"
