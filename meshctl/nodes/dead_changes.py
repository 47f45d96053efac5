"""End what a dead meshctl process of this machine left on nodes: its lock, and a change that was not confirmed.

Nothing else ends these before they expire. `observe_cleared` does it for one node. `clear_all` does it for many: the
farthest first, because a node that returns to its former cell cuts the path to those behind it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from itertools import groupby

from meshctl.device import deadman
from meshctl.device.errors import NodeRefused
from meshctl.device.observation import ChangeStatus, Observation
from meshctl.device.observe import observe
from meshctl.device.ssh import SshConnection
from meshctl.errors import NodeError, Unreachable
from meshctl.fleet import Interrupt, Outcome, Result, run
from meshctl.fleet.process import is_dead
from meshctl.model import Node
from meshctl.nodes.backoff import Backoff
from meshctl.nodes.connections import ConnectionPool
from meshctl.topology import Graph

# How long a node may take to roll back a change of a dead process: its files, and a reload.
CLEARING_S = 60.0


def is_left_by_dead(observation: Observation) -> bool:
    """Whether a dead process of this machine holds the node's lock, or began its change."""
    change = observation.change
    return change is not None and (is_dead(change.lock_owner) or (is_dead(change.owner) and change.state != "idle"))


def observe_cleared(connection: SshConnection, paths: tuple[str, ...], interrupt: Interrupt) -> Observation:
    """One observation, after clearing the lock and change of a dead meshctl process of this machine."""
    observation = observe(connection, extra_paths=paths)
    if not is_left_by_dead(observation):
        return observation
    backoff = Backoff(CLEARING_S, interrupt)
    while not backoff.is_over and not interrupt.leaving:
        _clear(connection, observation.change)
        observation = observe(connection, extra_paths=paths)
        if not _is_ending(observation):
            break
        backoff.pause()
    return observation


def clear_all(
    connections: ConnectionPool,
    nodes: Mapping[str, Node],
    observations: Mapping[str, Observation],
    graph: Graph,
    *,
    paths: Callable[[Node], tuple[str, ...]],
    parallel: int,
    interrupt: Interrupt,
) -> tuple[dict[str, Observation], dict[str, NodeError]]:
    """Abort the dead changes among these observations, then observe their nodes again: the new observations, and why
    nodes gave none."""
    left = [name for name, observation in observations.items() if is_left_by_dead(observation)]
    for batch in _farthest_first(left, graph, connections):
        run(batch, lambda name: _abort(connections, nodes[name], observations[name]), parallel=parallel)
    found: dict[str, Observation] = {}
    errors: dict[str, NodeError] = {}

    def await_end(name: str) -> Outcome:
        node, backoff = nodes[name], Backoff(CLEARING_S, interrupt)
        is_unended = is_left_by_dead
        while True:
            # the path may have been cut while the connection was open
            connections.drop(name)
            try:
                with connections.slots.use(name), connections.borrow(node) as connection:
                    found[name] = observe(connection, extra_paths=paths(node))
                    errors.pop(name, None)
                    if not is_unended(found[name]):
                        break
                    _clear(connection, found[name].change)
                    # a lock that it does not release now expires
                    is_unended = _is_ending
            except Unreachable as error:
                found.pop(name, None)
                errors[name] = error
            except NodeError as error:
                errors[name] = error
                break
            if backoff.is_over or interrupt.stopping:
                break
            backoff.pause()
        return Outcome(name, Result.DONE)

    run(left, await_end, parallel=parallel, interrupt=interrupt)
    return found, errors


def _farthest_first(names: list[str], graph: Graph, connections: ConnectionPool) -> list[list[str]]:
    """The nodes in batches of equal distance to their base, the farthest first and those without a path before all."""
    entries = [node.name for node in connections.fleet.base_nodes]
    hops = {name: -path.hops for name, path in graph.paths_to_any(entries).items()}
    nearest_last = sorted(names, key=lambda name: hops.get(name, -len(graph.neighbors) - 1))
    return [list(batch) for _, batch in groupby(nearest_last, key=lambda name: hops.get(name))]


def _abort(connections: ConnectionPool, node: Node, observation: Observation) -> Outcome:
    with connections.slots.use(node.name), connections.borrow(node) as connection:
        _clear(connection, observation.change)
    return Outcome(node.name, Result.DONE)


def _is_ending(observation: Observation) -> bool:
    change = observation.change
    return change is not None and is_dead(change.owner) and change.state not in ("idle", "staged")


def _clear(connection: SshConnection, change: ChangeStatus | None) -> None:
    if change is None:
        return
    # if the node refuses, its next status shows why
    with suppress(NodeRefused):
        if is_dead(change.owner) and change.change_id and change.state not in ("idle", "restoring"):
            deadman.abort(connection, change.owner, change.change_id)
    with suppress(NodeRefused):
        if is_dead(change.lock_owner):
            deadman.unlock(connection, change.lock_owner)
