"""Provision factory devices: each answers at 192.168.1.1, without a password and with an unknown host key.

For each bench target (an address, a forwarded port, an interface): connect, observe, identify the node (`identify`,
pure), refuse a wrong device, pin the host key (`discover`). Then plan as for any other node (`plan_discovered`): the
change is sent over the bench connection, confirmed over the new address, and rolled back if that never answers.
"""

from __future__ import annotations

import threading
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

from meshctl.apply.neighbor_query import observe_neighbors
from meshctl.apply.prepare import PlanOptions, Prepared, assemble, other_paths
from meshctl.device.connection import Endpoint
from meshctl.device.observation import Observation
from meshctl.device.ssh import SshConnection, connect
from meshctl.device.trust import AcceptAnyKey, HostKey, TrustStore
from meshctl.errors import NodeError
from meshctl.fleet import Interrupt, Observer, Outcome, Result, run, silent
from meshctl.fleet.journal import LastKnown
from meshctl.model import Fleet, Node
from meshctl.nodes.collect import FleetObservation
from meshctl.nodes.connections import ConnectionPool
from meshctl.nodes.dead_changes import observe_cleared
from meshctl.nodes.desired import Renderer
from meshctl.topology import alternate_macs

FACTORY_ADDRESS = "192.168.1.1"


@dataclass(frozen=True, slots=True)
class BenchTarget:
    """Where one device answers. `node` is the name the operator gave, empty to identify it by MAC; `interface` the
    local interface it is plugged into, empty where only one device has the address; `site` the one on whose gateway's
    bench it is, empty for the operator's own."""

    host: str = FACTORY_ADDRESS
    port: int = 22
    node: str = ""
    interface: str = ""
    site: str = ""

    @property
    def endpoint(self) -> Endpoint:
        return Endpoint(self.host, self.port, interface=self.interface)

    @property
    def label(self) -> str:
        """Its address, and the site there: `192.168.1.1 at site north`."""
        return f"{self.endpoint.label} at site {self.site}" if self.site else self.endpoint.label

    def __str__(self) -> str:
        where = self.label
        return f"{self.node} at {where}" if self.node else where


@dataclass(frozen=True, slots=True)
class FoundDevice:
    """A device on the bench: its node, observation and host key, and the keys pinned before."""

    target: BenchTarget
    node: Node
    observation: Observation
    key: HostKey
    old_pins: tuple[HostKey, ...] = ()


def identify(fleet: Fleet, observation: Observation, requested_name: str, identified: Iterable[str] = ()) -> Node:
    """The node this device is: by MAC, or by `requested_name`, the operator's, where the inventory has no MAC.

    Raises NodeError for a device that is another node than `requested_name`, or that cannot be identified.
    """
    macs = {mac.lower() for mac in (observation.macs or {}).values()}
    if observation.board is not None and observation.board.label_mac:
        macs.add(observation.board.label_mac.lower())
    # a radio may be recorded by its address in the mesh, which differs from the factory one
    alternates = {other for link in observation.links or () for other in alternate_macs(link.mac)}
    by_mac = [node for node in fleet.managed() if _macs(node) & (macs | alternates)]
    macs_text = ", ".join(sorted(macs)) or "none"
    if len(by_mac) > 1:
        raise NodeError(f"its MACs ({macs_text}) belong to several nodes: {', '.join(node.name for node in by_mac)}")
    if requested_name:
        node = fleet.nodes[requested_name]
        if by_mac and by_mac[0].name != node.name:
            raise NodeError(
                f"wrong device: expected {node.name}, its MAC belongs to {by_mac[0].name}",
                hint="swap the cables, or omit the node names: devices are then identified by MAC",
            )
        if _macs(node) and not by_mac:
            expected = ", ".join(sorted(_macs(node)))
            raise NodeError(
                f"wrong device: {node.name} has MAC {expected}, this one has {macs_text}",
                hint=f"connect {node.name}, or correct its `mac` in the inventory",
            )
    elif by_mac:
        node = by_mac[0]
    else:
        raise NodeError(
            f"cannot identify the node: no node of the inventory has one of its MACs ({macs_text})",
            hint="name the node (`meshctl bootstrap NODE`), or add its MAC to the inventory",
        )
    if node.name in set(identified):
        raise NodeError(f"{node.name} was already found at another address or interface")
    return node


def _macs(node: Node) -> set[str]:
    return {mac.lower() for mac in (node.mac, *(radio.mac for radio in node.radios)) if mac}


@dataclass(frozen=True, slots=True)
class Discovered:
    """`found`: node -> device. `outcomes`: of the targets where no device was accepted."""

    found: Mapping[str, FoundDevice]
    outcomes: tuple[Outcome, ...]


def discover(
    renderer: Renderer,
    connections: ConnectionPool,
    trust: TrustStore,
    targets: Sequence[BenchTarget],
    *,
    parallel: int,
    replace_keys: bool = False,
    interrupt: Interrupt | None = None,
    observer: Observer = silent,
) -> Discovered:
    """Identify the device at each target, pin its host key, and keep its connection in the pool."""
    found: dict[str, FoundDevice] = {}
    lock = threading.Lock()
    signal = interrupt or Interrupt()
    by_name = {str(target): target for target in targets}

    def identify_one(name: str) -> Outcome:
        target = by_name[name]
        host_key_policy = AcceptAnyKey()
        connection = connect_to_bench(connections, target, host_key_policy)
        try:
            with lock:
                identified = tuple(found)
            observation = observe_cleared(connection, _paths(renderer, target), signal)
            node = identify(renderer.fleet, observation, target.node, identified)
            require_site(node, target)
            assert host_key_policy.key is not None
            old_pins = trust.pinned(node.name)
            _pin(trust, node.name, host_key_policy.key, replace_keys=replace_keys)
        except BaseException:
            connection.close()
            raise
        with lock:
            found[node.name] = FoundDevice(target, node, observation, host_key_policy.key, old_pins)
            if not target.site:
                connections.on_bench.add(node.name)
            connections.bench_endpoints[node.name] = replace(connection.endpoint, identity=node.name)
            if target.interface:
                connections.interfaces[node.name] = target.interface
        connections.release(node.name, connection)
        return Outcome(name, Result.DONE)

    ended = run(by_name, identify_one, parallel=parallel, interrupt=signal, observer=observer)
    return Discovered(found, tuple(outcome for outcome in ended.values() if not outcome.result.is_good))


def connect_to_bench(connections: ConnectionPool, target: BenchTarget, host_key_policy: AcceptAnyKey) -> SshConnection:
    """Log in without a password, or with the fleet's keys where an earlier run was cut short."""
    fleet = connections.fleet
    node = fleet.nodes[target.node] if target.node else next(fleet.managed())
    return connect(
        target.endpoint,
        credentials=replace(connections.credentials(node), empty_password=True),
        trust=host_key_policy,
        deadlines=connections.deadlines,
        via=connections.gateway(fleet.sites[target.site]) if target.site else None,
        release=node.release if target.node else None,
    )


def require_site(node: Node, target: BenchTarget) -> None:
    """The new address is reached the same way. Raises NodeError for a node of elsewhere."""
    if target.site and node.site != target.site:
        raise NodeError(
            f"{node.name} is at site {target.site}, and in the inventory at {node.site or 'none'}",
            hint=f"correct its `site` in the inventory, or bring it to {node.site or 'this computer'}",
        )


def _paths(renderer: Renderer, target: BenchTarget) -> tuple[str, ...]:
    """The files to observe. The node may not be identified yet, but the paths hardly differ between nodes."""
    fleet = renderer.fleet
    node = fleet.nodes[target.node] if target.node else next(fleet.managed())
    return other_paths(renderer.desired(node))


def _pin(trust: TrustStore, name: str, key: HostKey, *, replace_keys: bool) -> None:
    pinned = trust.pinned(name)
    if key in pinned:
        return
    if pinned and not replace_keys:
        raise NodeError(
            f"host key mismatch: {name} is pinned with {pinned[0].fingerprint}, this device has {key.fingerprint}",
            hint="if the device was reset or replaced, run again with --replace-key",
        )
    trust.replace(name, key)


def restore_pins(trust: TrustStore, discovered: Discovered, names: Iterable[str]) -> None:
    """Pin the previous keys of these nodes again, because their devices were refused."""
    for name in names:
        trust.replace(name, *discovered.found[name].old_pins)


def plan_discovered(
    renderer: Renderer,
    connections: ConnectionPool,
    discovered: Discovered,
    known: Mapping[str, LastKnown],
    *,
    salt: bytes,
    owner: str,
    choices: PlanOptions | None = None,
    interrupt: Interrupt | None = None,
) -> Prepared:
    """The plan that provisions the discovered devices. Their possible neighbors are observed, too: a spare, or a device
    that was reset, may have been in the mesh before."""
    rendered = {name: renderer.desired(item.node) for name, item in discovered.found.items()}
    found = {name: item.observation for name, item in discovered.found.items()}
    made = assemble(
        renderer,
        connections,
        rendered,
        FleetObservation(found, {}),
        known,
        salt=salt,
        owner=owner,
        choices=choices or PlanOptions(),
    )
    return replace(
        made, neighbor_observations=observe_neighbors(connections, renderer.fleet, found, known, interrupt=interrupt)
    )
