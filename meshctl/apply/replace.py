"""Give a node's identity to another device: same name, address, role and place in the fleet, other hardware.

The old node is dead or gone; the new device is a spare that meshctl knows, or one on the bench. Its host key is pinned
for the old name, the old node's configuration goes there as any other change, and the inventory learns the new MAC,
serial number and label (`identity_edits`, pure). If the change fails, pins and inventory stay as they were.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

from meshctl.apply.bootstrap import BenchTarget, Discovered, FoundDevice
from meshctl.apply.prepare import other_paths
from meshctl.device.observation import Observation
from meshctl.device.ssh import connect
from meshctl.device.trust import AcceptAnyKey, HostKey, TrustStore
from meshctl.errors import InputError, NodeError
from meshctl.fleet import Interrupt
from meshctl.model import Fleet, Node, NodeState
from meshctl.nodes.collect import observe_cleared
from meshctl.nodes.connections import ConnectionPool
from meshctl.nodes.desired import Renderer


@dataclass(frozen=True, slots=True)
class Replacement:
    """The device that takes over: `spare` is its node in the inventory, None for a stranger on the bench."""

    discovered: Discovered
    spare: Node | None
    old_pins: tuple[HostKey, ...]


def adopt(
    renderer: Renderer,
    connections: ConnectionPool,
    trust: TrustStore,
    old: Node,
    *,
    spare: Node | None,
    target: BenchTarget | None,
    interrupt: Interrupt,
) -> Replacement:
    """Meet the new device and pin its key under the old node's name.

    Raises NodeError when the old node still answers as itself, or the new device does not.
    """
    _require_unreachable(connections, old)
    recorder = AcceptAnyKey()
    if target is not None:
        credentials = replace(connections.credentials(old), empty_password=True)
        connection = connect(
            target.endpoint,
            credentials=credentials,
            trust=recorder,
            deadlines=connections.deadlines,
            release=old.release,
        )
        key = recorder.key
    elif spare is not None:
        # known by name, so its own pin has to fit
        connection = connections.open(spare)
        key = connection.host_key
    else:
        raise InputError("expected a spare of the inventory, or a place on the bench")
    try:
        seen = observe_cleared(connection, other_paths(renderer.desired(old)), interrupt)
        if key is None:
            raise NodeError(f"{connection.endpoint.label}: showed no host key")
    except BaseException:
        connection.close()
        raise
    pins = trust.pinned(old.name)
    trust.replace(old.name, key)
    connections.bench_endpoints[old.name] = replace(connection.endpoint, identity=old.name)
    if connection.endpoint.interface:
        connections.interfaces[old.name] = connection.endpoint.interface
    connections.release(old.name, connection)
    where = target or BenchTarget(connection.endpoint.host, connection.endpoint.port, old.name)
    return Replacement(Discovered({old.name: FoundDevice(where, old, seen, key)}, ()), spare, pins)


def _require_unreachable(connections: ConnectionPool, old: Node) -> None:
    """Two devices with one address and one name would fight: the old one has to be off."""
    try:
        connections.open(old).close()
    except NodeError:
        return
    raise NodeError(
        f"{old.name} still answers at {connections.endpoint(old).address}: two nodes with one address would fight",
        hint="switch the old one off first",
    )


def restore_old_pins(trust: TrustStore, old: Node, replacement: Replacement) -> None:
    """The change failed: believe what was believed before."""
    trust.replace(old.name, *replacement.old_pins)


def with_identity(fleet: Fleet, old: Node, spare: Node | None) -> Fleet:
    """The fleet in which the old node carries the spare's label and serial number, as far as they are rendered."""
    if spare is None:
        return fleet
    adopted = replace(old, label=spare.label or old.label, serial=spare.serial or old.serial)
    return replace(fleet, nodes=MappingProxyType({**fleet.nodes, old.name: adopted}))


def identity_edits(old: Node, spare: Node | None, seen: Observation) -> tuple[Mapping[str, str], Mapping[str, str]]:
    """What the inventory shall say afterwards: of the old node's entry, and of the spare's (empty for none).

    Only keys that the inventory uses are written: a fleet that identifies nodes by label need not know MACs.
    """
    mine: dict[str, str] = {}
    label_mac = seen.board.label_mac if seen.board is not None else ""
    mac = (spare.mac if spare is not None else "") or label_mac
    if mac and (old.mac or (spare is not None and spare.mac)):
        mine["mac"] = mac
    if spare is not None:
        mine.update({key: value for key, value in (("serial", spare.serial), ("label", spare.label)) if value})
    theirs = {"state": NodeState.RETIRED.value} if spare is not None else {}
    return mine, theirs
