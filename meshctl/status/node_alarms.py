"""Alarms of a radio that answers, one function per concern.

A node's state decides what is expected: a deployed beacon must hear other nodes, a carried one need not. An alarm's
hint says what to do.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from meshctl import wording
from meshctl.device.observation import Observation
from meshctl.model import Fleet, Node, NodeState, Role
from meshctl.plan import NodePlan, Verdict
from meshctl.plan.left_over import left_over
from meshctl.report.duration import duration
from meshctl.status.values import Alarm, Level, Neighbor, RadioStatus
from meshctl.topology import Path
from meshctl.wording import counted, lock_owners

# below this the path loses more than it delivers: move a beacon
WEAK_QUALITY = 0.3
# below this the kernel may kill a reload or an upgrade (OOM)
LOW_MEMORY_SHARE = 0.1
# the dead-man's switch stores the previous state in flash: about this much with headroom
LOW_FLASH_BYTES = 256 * 1024
# with this load per processor a forwarding radio answers late and drops frames
BUSY_LOAD = 4.0
# Operators' thresholds of Silvus StreamScape (SC44-520): a link below 10 dB SNR and a node with more than 100 packets
# queued are red.
LOW_SNR_DB = 10
LONG_QUEUE_PACKETS = 100
# Doodle Labs calls more activity than this not ideal.
BUSY_CHANNEL_RATIO = 0.8
# radios have no battery-backed clock and often no NTP: only an offset that breaks logs and certificates matters
CLOCK_TOLERANCE_S = 3600.0


# how iw names the modes that a mesh runs in
MESH_MODES = ("ibss", "mesh point")
MAX_NAMES = 6
# of a change, while its services reload or may do so
_RELOADING_STATES = ("waiting", "applied", "restoring")


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
    """Whether enough nodes were queried to know its path."""
    cuts_off: tuple[str, ...]
    relays: tuple[str, ...]
    """Nodes whose path to the base uses it."""
    seconds_since_last_known: float | None
    """Time between the previous snapshot, if any, and this one."""
    own_lock: str
    radios: tuple[RadioStatus, ...] = ()

    @property
    def must_mesh(self) -> bool:
        """Whether it should be in its mesh now: deployed, and not the only deployed node."""
        others = (n for mesh in self.node.meshes for n in self.fleet.members(mesh) if n.name != self.node.name)
        return self.node.state is NodeState.DEPLOYED and any(n.state is NodeState.DEPLOYED for n in others)

    @property
    def is_reloading(self) -> bool:
        """Whether its services, and with them its radios, may just be restarting: it has the alarm `change`."""
        change = self.observation.change
        return change is not None and (change.state in _RELOADING_STATES or change.is_reloading_restored)


def alarms(facts: NodeAlarmInput) -> tuple[Alarm, ...]:
    """All alarms of a node, most severe first."""
    concerns = [concern for concern in _CONCERNS if not (facts.is_reloading and concern in _OF_RADIOS)]
    found = [alarm for concern in concerns for alarm in concern(facts)]
    return tuple(sorted(found, key=lambda alarm: -alarm.level))


def _identity(facts: NodeAlarmInput) -> Iterator[Alarm]:
    board = facts.observation.board
    if board is not None and board.board_name and board.board_name != facts.node.hardware.board:
        text = f"expected board {facts.node.hardware.board}, found {board.board_name}"
        hint = f"check the device's label, or fix nodes.{facts.node.name} in the inventory"
        yield Alarm(Level.ERROR, "board", text, hint)


def _drift(facts: NodeAlarmInput) -> Iterator[Alarm]:
    plan, name = facts.plan, facts.node.name
    if plan is None:
        return
    if plan.verdict is Verdict.REFUSED:
        yield Alarm(Level.ERROR, "refused", f"cannot be provisioned: {plan.reason}", plan.hint)
    if plan.firmware is not None:
        text = f"expected firmware {plan.firmware.to_revision}, found {plan.firmware.from_revision or 'unknown'}"
        yield Alarm(Level.WARNING, "firmware", text, f"meshctl plan {name}, then meshctl provision {name}")
    if plan.packages is not None:
        text = f"packages missing: {', '.join(plan.packages.install)}"
        yield Alarm(Level.WARNING, "packages", text, f"meshctl provision {name}")
    if plan.files:
        names = ", ".join(change.path.removeprefix("etc/config/") for change in plan.files)
        hint = f"meshctl plan {name} shows the differences; meshctl provision {name} fixes them"
        yield Alarm(Level.WARNING, "drift", f"configuration differs: {names}", hint)


def _left_over(facts: NodeAlarmInput) -> Iterator[Alarm]:
    """A mesh that it has left may still be joined through it, and others may be disturbed on its channel."""
    for name in left_over(facts.observation):
        text = f"{name} is on the air, although its configuration has turned it off"
        yield Alarm(Level.WARNING, "left-over", text, f"meshctl provision {facts.node.name} takes it down")


def _radios(facts: NodeAlarmInput) -> Iterator[Alarm]:
    mesh_radios = {radio.name for radio in facts.node.radios if radio.mesh is not None}
    for radio in facts.observation.radios or ():
        if radio.name in mesh_radios and (not radio.up or radio.setup_failed):
            why = "setup failed" if radio.setup_failed else "disabled" if radio.disabled else "down"
            hint = f"meshctl run {facts.node.name} -- logread -e netifd"
            yield Alarm(Level.ERROR, "radio", f"{radio.name} is {why}", hint)
    every = {facts.fleet.meshes[mesh].channel for mesh in facts.node.meshes}
    own = {name: {facts.fleet.meshes[mesh].channel} for name, mesh in facts.node.mesh_interfaces.items()}
    for link in facts.observation.links or ():
        if link.mode.upper() == "IBSS" and link.joined is False:
            hint = "check channel, SSID, BSSID and key; meshctl topology shows the nodes in the cell"
            yield Alarm(Level.ERROR, "join", f"{link.ifname} has joined no cell", hint)
        # each radio of a relay has its own mesh; interfaces with other names are not ours
        channels = own.get(link.ifname, every)
        if link.mode.lower() in MESH_MODES and link.channel is not None and link.channel not in channels:
            text = f"{link.ifname} is on channel {link.channel}, its mesh on {', '.join(map(str, sorted(channels)))}"
            yield Alarm(Level.ERROR, "channel", text, f"meshctl plan {facts.node.name}")


def _mesh(facts: NodeAlarmInput) -> Iterator[Alarm]:
    if facts.must_mesh and not facts.neighbors:
        yield Alarm(
            Level.ERROR,
            "alone",
            "hears no other node",
            "check antennas, distance and interference",
        )
    elif facts.must_mesh and facts.path is None and facts.is_path_known:
        text = "no path through the mesh to the base"
        yield Alarm(Level.WARNING, "no-path", text, "find the missing node between them with meshctl topology")
    elif facts.path is not None and facts.path.hops and facts.path.quality < WEAK_QUALITY:
        hops = counted(facts.path.hops, "hop")
        text = f"path to the base has {facts.path.quality:.0%} quality over {hops}"
        yield Alarm(Level.WARNING, "weak", text, f"drop a beacon between {facts.node.name} and {facts.path.via}")
    if facts.cuts_off and facts.node.state is NodeState.DEPLOYED:
        yield Alarm(Level.NOTE, "cut-vertex", f"without it {join_limited(facts.cuts_off)} would be cut off")


def _air(facts: NodeAlarmInput) -> Iterator[Alarm]:
    """The signal to the next hop, the channel, and the radio's queue."""
    via = facts.path.via if facts.path is not None and facts.path.hops else ""
    for neighbor in facts.neighbors:
        snr_db = neighbor.worse_snr_db
        if neighbor.name == via and snr_db is not None and snr_db < LOW_SNR_DB:
            text = f"the signal between it and {via} is {snr_db} dB above the noise"
            yield Alarm(
                Level.WARNING, "snr", text, f"move closer, or drop a beacon between {facts.node.name} and {via}"
            )
    for radio in facts.radios:
        if radio.busy_ratio is not None and radio.busy_ratio > BUSY_CHANNEL_RATIO:
            channel = "" if radio.channel is None else f" {radio.channel}"
            text = f"channel{channel} is busy for {radio.busy_ratio:.0%} of the time at {radio.ifname}"
            yield Alarm(Level.WARNING, "busy", text, "send less, or change the channel of the mesh")
        if radio.queue_packets is not None and radio.queue_packets > LONG_QUEUE_PACKETS:
            text = f"{radio.queue_packets} packets are queued at {radio.ifname}"
            yield Alarm(Level.WARNING, "radio-queue", text, "send less through it, or improve its links")


def _dropped(facts: NodeAlarmInput) -> Iterator[Alarm]:
    """A beacon marked as carried that other nodes depend on."""
    if facts.node.state is NodeState.CARRIED and facts.node.role is Role.BEACON and facts.relays:
        text = f"marked as carried, but relays to the base for {join_limited(facts.relays)}"
        yield Alarm(Level.NOTE, "dropped", text, f"if it has been dropped: meshctl deployed {facts.node.name}")


def _bridge(facts: NodeAlarmInput) -> Iterator[Alarm]:
    """A LAN port in no bridge connects nothing to the mesh."""
    bridges = facts.observation.bridges
    if bridges is None or not facts.node.meshes:
        return
    joined = {port for bridge in bridges for port in bridge.ports}
    missing = [port for port in facts.node.lan_ports if port not in joined]
    if missing:
        level = Level.WARNING if facts.node.role is Role.BEACON else Level.ERROR
        text = f"{', '.join(missing)} in no bridge: devices connected there are not in the mesh"
        yield Alarm(level, "bridge", text, f"meshctl plan {facts.node.name}")


def _lan_filter(facts: NodeAlarmInput) -> Iterator[Alarm]:
    """A filter that is configured, but not loaded; with other files than the inventory's, that is the alarm."""
    plan = facts.plan
    if facts.node.lan_filter is None or not facts.node.bridges_lan or plan is None or plan.files:
        return
    if facts.observation.lan_filter is None:
        text = "its LAN filter is not loaded: broadcasts of its wired ports reach the mesh"
        yield Alarm(Level.WARNING, "lan-filter", text, f"meshctl run {facts.node.name} -- logread -e meshctl")


def _resources(facts: NodeAlarmInput) -> Iterator[Alarm]:
    memory, flash, load = facts.observation.memory, facts.observation.overlay, facts.observation.load
    if memory is not None and memory.total and memory.available / memory.total < LOW_MEMORY_SHARE:
        text = f"{memory.available / 2**20:.1f} MiB of memory left"
        yield Alarm(Level.WARNING, "memory", text, "reboot it before changing anything on it")
    if flash is not None and flash.free < LOW_FLASH_BYTES:
        hint = "remove packages or files: a change stores the previous state in flash"
        yield Alarm(Level.WARNING, "flash", f"{flash.free // 1024} KiB of flash left", hint)
    if load is not None and load.minute / load.processors > BUSY_LOAD:
        text = f"load {load.minute:.1f} on {counted(load.processors, 'processor')}"
        yield Alarm(Level.NOTE, "load", text, f"meshctl run {facts.node.name} -- top -b -n 1")


def _changes(facts: NodeAlarmInput) -> Iterator[Alarm]:
    change = facts.observation.change
    if change is not None and change.state not in ("idle", "", "unknown", "absent"):
        left = "" if change.left_s is None else f", {change.left_s:.0f} s left"
        text = f"a change by {lock_owners(change.owner) or 'an unknown owner'} is {change.state}{left}"
        yield Alarm(Level.WARNING, "change", text, "wait until it is confirmed or rolled back")
    elif change is not None and change.is_reloading_restored:
        text = "its services are still reloading after a rollback"
        yield Alarm(Level.WARNING, "change", text, "wait until that has ended: it takes up to a minute")
    if change is not None and change.lock_owner and change.lock_owner != facts.own_lock:
        yield Alarm(Level.NOTE, "locked", f"locked by {lock_owners(change.lock_owner)}")
    if facts.observation.uci_changes:
        count = len(facts.observation.uci_changes)
        text = f"{counted(count, 'uncommitted UCI change')} made by hand"
        hint = f"meshctl run {facts.node.name} -- uci changes; move them into the inventory, or `uci revert` them"
        yield Alarm(Level.WARNING, "foreign", text, hint)


def _time(facts: NodeAlarmInput) -> Iterator[Alarm]:
    offset_s, uptime_s = facts.observation.clock_offset_s, facts.observation.uptime_s
    if offset_s is not None and abs(offset_s) > CLOCK_TOLERANCE_S:
        yield Alarm(Level.NOTE, "clock", f"its clock is off by {duration(abs(offset_s))}")
    since_s = facts.seconds_since_last_known
    if uptime_s is not None and since_s is not None and uptime_s < since_s:
        yield Alarm(Level.NOTE, "rebooted", f"rebooted {duration(uptime_s)} ago")


def join_limited(names: tuple[str, ...]) -> str:
    """As many names as an alarm has room for, and the number of others."""
    return wording.join_limited(names, MAX_NAMES)


_CONCERNS: tuple[Callable[[NodeAlarmInput], Iterator[Alarm]], ...] = (
    _identity,
    _drift,
    _radios,
    _left_over,
    _mesh,
    _air,
    _dropped,
    _bridge,
    _lan_filter,
    _resources,
    _changes,
    _time,
)
# what a radio that restarts in a change causes by itself
_OF_RADIOS = (_radios, _left_over, _mesh)
