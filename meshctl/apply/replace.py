"""Replace a node's hardware: another device takes over its name, address and role.

The new device is a spare of the inventory, or one on the bench. `adopt` also pins its host key under the old name; the
old node's configuration is then applied as any other change, and the inventory gets the new MAC, serial number and
label (`identity_edits`, pure). If the change fails, pins and inventory stay as they were. If meshctl is killed, or does
not know how the change ended, both devices are trusted under the old name, and the same command completes what is left:
a device that has taken over by then is known by its host key, which is pinned under `name_of_new` until the end.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass, replace
from types import MappingProxyType

from meshctl.apply.bootstrap import (
    BenchTarget,
    Discovered,
    FoundDevice,
    connect_to_bench,
    require_site,
    restore_pins,
)
from meshctl.apply.prepare import other_paths
from meshctl.device.observation import Observation
from meshctl.device.ssh import SshConnection
from meshctl.device.trust import AcceptAnyKey, HostKey, TrustStore
from meshctl.errors import InputError, NodeError, Unreachable
from meshctl.fleet import Interrupt, Result
from meshctl.model import Fleet, Node, NodeState, Role
from meshctl.nodes.connections import ConnectionPool
from meshctl.nodes.dead_changes import observe_cleared
from meshctl.nodes.desired import Renderer


@dataclass(frozen=True, slots=True)
class Replacement:
    """The device that takes over: its host key is also pinned under `new_name`, where `new_pins` were before."""

    discovered: Discovered
    new_name: str
    new_pins: tuple[HostKey, ...]

    def put_back_pins(self, trust: TrustStore) -> None:
        """Pin the previous keys again, because the device has not taken over."""
        restore_pins(trust, self.discovered, self.discovered.found)
        trust.replace(self.new_name, *self.new_pins)


def name_of_new(old: Node, spare: Node | None) -> str:
    """The name in known_hosts of a device that takes over: the spare's; a device on the bench has none of its own."""
    return spare.name if spare is not None else f"{old.name}.replacement"


def has_old_state(result: Result) -> bool:
    """Whether a device whose change ended so is certain not to have taken over."""
    return not result.is_good and result is not Result.UNCERTAIN


def adopt(
    renderer: Renderer,
    connections: ConnectionPool,
    trust: TrustStore,
    old: Node,
    *,
    spare: Node | None,
    target: BenchTarget | None,
    has_taken_over: bool,
    interrupt: Interrupt,
) -> Replacement:
    """Connect to the new device and pin its key under the old node's name, too. A spare that `has_taken_over` answers
    at the old node's address.

    Raises NodeError when the new device does not answer.
    """
    recorder = AcceptAnyKey()
    if target is not None:
        require_site(old, target)
        connection = connect_to_bench(connections, target, recorder)
        key = recorder.key
    # checked against its own pin
    elif has_taken_over:
        connection = connections.open(old)
        key = connection.host_key
    elif spare is not None:
        connection = _open_spare(connections, spare, old)
        key = connection.host_key
    else:
        raise InputError("expected a spare of the inventory, or a device on the bench")
    try:
        observation = observe_cleared(connection, other_paths(renderer.desired(old)), interrupt)
        if key is None:
            raise NodeError(f"{connection.endpoint.label}: sent no host key")
    except BaseException:
        connection.close()
        raise
    pins = trust.pinned(old.name)
    # the old device's key stays until the change is confirmed: whatever ends this process, both are trusted
    trust.replace(old.name, key, *(pin for pin in pins if pin != key))
    new_name = name_of_new(old, spare)
    new_pins = trust.pinned(new_name)
    if key not in new_pins:
        trust.replace(new_name, key)
    if (target is not None and not target.site) or (spare is not None and spare.name in connections.on_bench):
        connections.on_bench.add(old.name)
    if not has_taken_over:
        connections.bench_endpoints[old.name] = replace(connection.endpoint, identity=old.name)
    if connection.endpoint.interface:
        connections.interfaces[old.name] = connection.endpoint.interface
    connections.release(old.name, connection)
    where = target or BenchTarget(connection.endpoint.host, connection.endpoint.port, old.name)
    return Replacement(Discovered({old.name: FoundDevice(where, old, observation, key, pins)}, ()), new_name, new_pins)


def _open_spare(connections: ConnectionPool, spare: Node, old: Node) -> SshConnection:
    """A connection to a spare: through the gateway of its site, or else on the bench."""
    site = connections.fleet.gateway_site(spare)
    if site is None:
        try:
            return connections.open(spare)
        except Unreachable as error:
            if not error.hint:
                # a spare is often as it came out of its box
                error.hint = f"if {spare.name} has its factory settings, say where it is: --interface IF or --at HOST"
            raise
    try:
        connection = connections.open(spare)
    except Unreachable:
        connections.on_bench.add(spare.name)
        return connections.open(spare)
    if spare.site != old.site:
        connection.close()
        raise NodeError(
            f"{spare.name} is at site {spare.site}, and {old.name} at {old.site or 'none'}",
            hint=f"take {spare.name} to where {old.name} was, or to a bench, and repeat",
        )
    return connection


def require_off(connections: ConnectionPool, trust: TrustStore, old: Node, spare: Node | None) -> bool:
    """The old device must be off: two devices with the same address conflict. Returns whether the new one answers
    there, because a replacement by it was cut short after its change.

    Raises NodeError, also if the gateway on the way to it cannot be asked.
    """
    try:
        connection = connections.open(old)
    except NodeError as error:
        if error.gateway_of:
            raise
        return False
    with closing(connection):
        if connection.host_key in trust.pinned(name_of_new(old, spare)):
            return True
    raise still_on(old, str(connections.endpoint(old).address))


def still_on(old: Node, where: str) -> NodeError:
    return NodeError(
        f"{old.name} still answers at {where}: two nodes must not have the same address",
        hint="switch the old device off first",
    )


def state_after(old: Node) -> NodeState:
    """The state of the old node on its new device: one that was lost is in use again, in its robot's rack if it has
    one."""
    if old.state is not NodeState.LOST:
        return old.state
    return NodeState.CARRIED if old.role is Role.BEACON and old.robot else NodeState.DEPLOYED


def with_identity(fleet: Fleet, old: Node, spare: Node | None) -> Fleet:
    """The fleet with the old node in use, and with the spare's label and serial number, because templates may render
    them."""
    adopted = replace(old, state=state_after(old))
    if spare is not None:
        adopted = replace(adopted, label=spare.label or old.label, serial=spare.serial or old.serial)
    return replace(fleet, nodes=MappingProxyType({**fleet.nodes, old.name: adopted}))


def identity_edits(
    old: Node, spare: Node | None, observation: Observation
) -> tuple[Mapping[str, str], Mapping[str, str]]:
    """The keys to set in the inventory: in the old node's entry, and in the spare's (empty for none).

    A MAC is written only where the inventory has one: a fleet may identify its nodes by label.
    """
    node_edits: dict[str, str] = {}
    label_mac = observation.board.label_mac if observation.board is not None else ""
    mac = (spare.mac if spare is not None else "") or label_mac
    if mac and (old.mac or (spare is not None and spare.mac)):
        node_edits["mac"] = mac
    if spare is not None:
        node_edits.update({key: value for key, value in (("serial", spare.serial), ("label", spare.label)) if value})
    if state_after(old) is not old.state:
        node_edits["state"] = state_after(old).value
    spare_edits = {"state": NodeState.RETIRED.value} if spare is not None else {}
    return node_edits, spare_edits
