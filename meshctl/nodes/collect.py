"""Observe many nodes: their observations, why others gave none, and the mesh graph.

`collect` observes nodes in parallel over pooled connections. Where a dead meshctl process of this machine left a lock
or an armed change, it clears these and observes again (`dead_changes`).
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from ipaddress import ip_address

from meshctl.device.errors import Timeout
from meshctl.device.observation import Observation
from meshctl.device.observe import observe
from meshctl.errors import NodeError, Unreachable
from meshctl.fleet import Interrupt, Observer, Outcome, Result, run, silent
from meshctl.fleet.journal import LastKnown
from meshctl.model import Fleet, Node, NodeState
from meshctl.nodes.connections import ConnectionPool, SshAddress
from meshctl.nodes.dead_changes import clear_all, is_left_by_dead
from meshctl.plan.lockout import SSH_PORT, listening_ports
from meshctl.plan.observed_files import management_address, parsed
from meshctl.topology import Graph, Report, mesh_macs, observed_graph, report_of, with_alternates


@dataclass(frozen=True, slots=True)
class FleetObservation:
    """`observations` of the nodes that answered; why others gave none: `unreachable`, or `refused` (a host key or login
    that does not match)."""

    observations: Mapping[str, Observation]
    unreachable: Mapping[str, str]
    refused: Mapping[str, NodeError] = field(default_factory=dict)
    # the unreachable nodes whose SSH server has accepted a connection, and then did not answer
    silent_servers: frozenset[str] = frozenset()

    def graph(self, fleet: Fleet, known: Mapping[str, LastKnown]) -> Graph:
        """The mesh as these nodes observe it."""
        return fleet_graph(fleet, known, reports_of(self.observations))


def reports_of(observations: Mapping[str, Observation]) -> dict[str, Report]:
    """The report of each node."""
    return {name: report_of(name, observation) for name, observation in observations.items()}


def fleet_graph(fleet: Fleet, known: Mapping[str, LastKnown], reports: Mapping[str, Report]) -> Graph:
    """The mesh as the nodes report it. The radios of a robot are wired together."""
    wires = [
        (first, second)
        for robot in fleet.robots.values()
        for index, first in enumerate(robot.nodes)
        for second in robot.nodes[index + 1 :]
        if first in reports and second in reports
    ]
    return observed_graph(reports.values(), known_macs=known_macs(fleet, known), wires=wires)


def known_macs(fleet: Fleet, known: Mapping[str, LastKnown]) -> dict[str, str]:
    """MAC -> node: from the inventory, from the journal, and alternate MACs of these radios.

    The journal's MACs of a retired node are left out: its device may be another node now.
    """
    macs = {
        mac.lower(): name
        for name, last in known.items()
        for mac in last.facts.get("macs", "").split()
        if name in fleet.nodes and fleet.nodes[name].state is not NodeState.RETIRED
    }
    for node in fleet.nodes.values():
        macs.update({radio.mac.lower(): node.name for radio in node.radios if radio.mac})
    return with_alternates(macs)


def former_places(fleet: Fleet, known: Mapping[str, LastKnown]) -> dict[str, SshAddress]:
    """Where nodes were last seen, if the inventory has another address or port by now: a node that was off, or that has
    not been changed yet, still answers there, on the mesh that it was in."""
    taken = {own.ip for node in fleet.managed() for own in node.addresses}
    found = {}
    for name, last in known.items():
        place, node = login_place(last.facts), fleet.nodes.get(name)
        if place is None or node is None or place == (node.address.ip, node.ssh.port):
            continue
        if place.address == node.address.ip or place.address not in taken:
            found[name] = place
    return found


def login_place(facts: Mapping[str, str]) -> SshAddress | None:
    """Where a node with these facts accepts logins; None if they do not say."""
    try:
        return SshAddress(ip_address(facts.get("address", "")), int(facts.get("port", SSH_PORT)))
    except ValueError:
        return None


def collect(
    connections: ConnectionPool,
    nodes: Iterable[Node],
    *,
    parallel: int,
    paths: Callable[[Node], Iterable[str]] = lambda node: (),
    interrupt: Interrupt | None = None,
    observer: Observer = silent,
) -> FleetObservation:
    """Observe these nodes; `paths` names further files to read. Connections stay in the pool."""
    wanted = {node.name: node for node in nodes}
    found: dict[str, Observation] = {}
    errors: dict[str, NodeError] = {}
    lock = threading.Lock()
    signal = interrupt or Interrupt()

    def observe_one(name: str) -> Outcome:
        try:
            with connections.slots.use(name), connections.borrow(wanted[name]) as connection:
                observation = observe(connection, extra_paths=tuple(paths(wanted[name])))
        except NodeError as error:
            with lock:
                errors[name] = error
            raise
        with lock:
            found[name] = observation
        return Outcome(name, Result.DONE)

    outcomes = run(wanted, observe_one, parallel=parallel, interrupt=signal, observer=observer)
    if any(is_left_by_dead(observation) for observation in found.values()) and not signal.stopping:
        graph = fleet_graph(connections.fleet, {}, reports_of(found))
        cleared, lost = clear_all(
            connections,
            wanted,
            found,
            graph,
            paths=lambda node: tuple(paths(node)),
            parallel=parallel,
            interrupt=signal,
        )
        found |= cleared
        for name, error in lost.items():
            found.pop(name, None)
            errors[name] = error
    unreachable = {
        name: str(errors[name]) if name in errors else outcome.reason
        for name, outcome in outcomes.items()
        if name not in found and (name not in errors or isinstance(errors[name], Unreachable))
    }
    refused = {name: error for name, error in errors.items() if not isinstance(error, Unreachable)}
    silent_servers = frozenset(
        name for name, error in errors.items() if isinstance(error, Timeout) and error.is_server_silent
    )
    return FleetObservation(
        {name: found[name] for name in wanted if name in found}, unreachable, refused, silent_servers
    )


def facts_of(observation: Observation) -> dict[str, str]:
    """The facts of a node that the journal stores: how to find it again, and its last known state."""
    address = management_address((observation.uci or {}).get("network"))
    dropbear = parsed((observation.uci or {}).get("dropbear"), "dropbear")
    facts = {
        "address": "" if address is None else str(address),
        "port": "" if dropbear is None else next(iter(listening_ports(dropbear)), ""),
        "macs": " ".join(mesh_macs(observation)),
        "boot_id": observation.boot_id or "",
        "uptime_s": "" if observation.uptime_s is None else f"{observation.uptime_s:.0f}",
        "board": observation.board.board_name if observation.board else "",
        "version": observation.release.version if observation.release else "",
        "revision": observation.release.revision if observation.release else "",
        "cell": "" if observation.links is None else "some" if mesh_macs(observation) else "none",
        "neighbours": " ".join(neighbor.mac for neighbor in observation.neighbors or ()),
    }
    return {key: value for key, value in facts.items() if value}
