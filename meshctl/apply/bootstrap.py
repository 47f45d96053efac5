"""Take factory devices into the fleet: they all answer at 192.168.1.1, with no password and nobody's keys.

`bootstrap`: for each place where one device answers (a port of the bench, an interface), connect, look, find out which
node it is (`identify`, pure), refuse the wrong one, pin its host key, and then provision it like any other node: the
change goes there over the bench, is confirmed over its new address, and undone if that never answers.
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
from meshctl.errors import InputError, NodeError
from meshctl.fleet import Interrupt, Observer, Outcome, Result, run, silent
from meshctl.fleet.journal import LastKnown
from meshctl.model import Fleet, Node
from meshctl.nodes.collect import FleetObservation, observe_cleared
from meshctl.nodes.connections import ConnectionPool
from meshctl.nodes.desired import Renderer
from meshctl.topology import alternate_macs

FACTORY_ADDRESS = "192.168.1.1"


@dataclass(frozen=True, slots=True)
class BenchTarget:
    """Where one device answers; `node` is whom the operator says it is, empty when the device has to tell; `interface`
    the interface of this machine that it is plugged into, empty where only one device has the address."""

    host: str = FACTORY_ADDRESS
    port: int = 22
    node: str = ""
    interface: str = ""

    @property
    def endpoint(self) -> Endpoint:
        return Endpoint(self.host, self.port, interface=self.interface)

    def __str__(self) -> str:
        where = self.endpoint.label
        return f"{self.node} at {where}" if self.node else where


@dataclass(frozen=True, slots=True)
class FoundDevice:
    """A device on the bench: which node it is, what it told, its host key, and the keys that were pinned before."""

    target: BenchTarget
    node: Node
    seen: Observation
    key: HostKey
    old_pins: tuple[HostKey, ...] = ()


def find_node(fleet: Fleet, word: str) -> Node:
    """The managed node that a name, label, serial number or MAC means. Raises InputError when none or several do."""
    folded = word.lower()
    found = [
        node
        for node in fleet.managed()
        if folded in {node.name.lower(), node.label.lower(), node.serial.lower(), node.mac.lower()} - {""}
        or any(radio.mac.lower() == folded for radio in node.radios if radio.mac)
    ]
    if len(found) != 1:
        names = ", ".join(node.name for node in found)
        raise InputError(
            f"{word!r} means {names if found else 'no node of the fleet'}",
            hint="give a node's name, label, serial number or MAC",
        )
    return found[0]


def identify(fleet: Fleet, seen: Observation, said: str, identified: Iterable[str] = ()) -> Node:
    """Which node this device is. Its MACs decide; where the inventory knows none, the operator's word does.

    Raises NodeError for a device that is not the one it is said to be, or that nothing identifies.
    """
    macs = {mac.lower() for mac in (seen.macs or {}).values()}
    if seen.board is not None and seen.board.label_mac:
        macs.add(seen.board.label_mac.lower())
    # a radio that is recorded by the address it had in the mesh shows another one now
    others = {other for link in seen.links or () for other in alternate_macs(link.mac)}
    by_mac = [node for node in fleet.managed() if _macs(node) & (macs | others)]
    shown = ", ".join(sorted(macs)) or "none"
    if len(by_mac) > 1:
        raise NodeError(f"its MACs ({shown}) belong to several nodes: {', '.join(node.name for node in by_mac)}")
    if said:
        node = find_node(fleet, said)
        if by_mac and by_mac[0].name != node.name:
            raise NodeError(f"wrong device: said to be {node.name}, its MAC is that of {by_mac[0].name}")
        if _macs(node) and not by_mac:
            expected = ", ".join(sorted(_macs(node)))
            raise NodeError(f"wrong device: {node.name} has {expected}, this one has {shown}")
    elif by_mac:
        node = by_mac[0]
    else:
        raise NodeError(
            f"nothing tells which node it is: no node of the inventory has one of its MACs ({shown})",
            hint="say it (`meshctl bootstrap NODE`), or write its MAC into the inventory",
        )
    if node.name in set(identified):
        raise NodeError(f"{node.name} was found at another place already")
    return node


def _macs(node: Node) -> set[str]:
    return {mac.lower() for mac in (node.mac, *(radio.mac for radio in node.radios)) if mac}


@dataclass(frozen=True, slots=True)
class Discovered:
    """`found`: node -> device. `outcomes`: what came of the places where nothing could be taken in."""

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
    """See who is where. Host keys are pinned, connections kept with `access` under the nodes' names."""
    found: dict[str, FoundDevice] = {}
    lock = threading.Lock()
    signal = interrupt or Interrupt()
    by_name = {str(target): target for target in targets}

    def identify_one(name: str) -> Outcome:
        target = by_name[name]
        host_key_policy = AcceptAnyKey()
        connection = _connect(connections, renderer.fleet, target, host_key_policy)
        try:
            with lock:
                identified = tuple(found)
            seen = observe_cleared(connection, _paths(renderer, target), signal)
            node = identify(renderer.fleet, seen, target.node, identified)
            assert host_key_policy.key is not None
            old_pins = trust.pinned(node.name)
            _pin(trust, node.name, host_key_policy.key, replace_keys=replace_keys)
        except BaseException:
            connection.close()
            raise
        with lock:
            found[node.name] = FoundDevice(target, node, seen, host_key_policy.key, old_pins)
            connections.bench_endpoints[node.name] = replace(connection.endpoint, identity=node.name)
            if target.interface:
                connections.interfaces[node.name] = target.interface
        connections.release(node.name, connection)
        return Outcome(name, Result.DONE)

    ended = run(by_name, identify_one, parallel=parallel, interrupt=signal, observer=observer)
    return Discovered(found, tuple(outcome for outcome in ended.values() if not outcome.result.is_good))


def _connect(
    connections: ConnectionPool, fleet: Fleet, target: BenchTarget, host_key_policy: AcceptAnyKey
) -> SshConnection:
    """Log in with no password, or with the fleet's keys where an earlier attempt has come half way."""
    some = next(fleet.managed())
    credentials = replace(connections.credentials(some), empty_password=True)
    release = find_node(fleet, target.node).release if target.node else None
    return connect(
        target.endpoint,
        credentials=credentials,
        trust=host_key_policy,
        deadlines=connections.deadlines,
        release=release,
    )


def _paths(renderer: Renderer, target: BenchTarget) -> tuple[str, ...]:
    """The files to look at; which node it is may not be known yet, and the paths are much the same for all."""
    fleet = renderer.fleet
    node = find_node(fleet, target.node) if target.node else next(fleet.managed())
    return other_paths(renderer.desired(node))


def _pin(trust: TrustStore, name: str, key: HostKey, *, replace_keys: bool) -> None:
    pinned = trust.pinned(name)
    if key in pinned:
        return
    if pinned and not replace_keys:
        raise NodeError(
            f"{name} is pinned with another host key ({pinned[0].fingerprint}), this device shows {key.fingerprint}",
            hint="if the device was reset or is a new one, run again with --replace-key",
        )
    trust.replace(name, key)


def restore_pins(trust: TrustStore, discovered: Discovered, names: Iterable[str]) -> None:
    """Trust the keys of before for these nodes: a device that was refused is not the node it was taken for."""
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
    """The plan that provisions the devices that were found. Whoever may know their radios is looked at, too: a spare
    may have been in the mesh, and a device that was reset was in it before."""
    rendered = {name: renderer.desired(item.node) for name, item in discovered.found.items()}
    found = {name: item.seen for name, item in discovered.found.items()}
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
