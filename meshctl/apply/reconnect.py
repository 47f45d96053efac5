"""Reach nodes that are back in their mesh, but whose unicast frames a neighbor drops, or that drop a neighbor's.

A node that rebooted within a minute numbers its frames from 0 again, and each neighbor that still has its station entry
drops them until the numbers have caught up: batman-adv hears it, logins time out for minutes (docs/lab.md). `reconnect`
has the neighbors that hear such a node remove their entries if they are stale, which they verify (`stale_stations`): by
its SSH server, too, since the numbers count for each traffic class, and replies to echo requests are of another one.
If a relay has rebooted, a node behind it drops the relay's frames, and only the relay can reach it: its numbers catch
up with as many echo requests as it takes.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass, replace

from meshctl.apply.context import RunContext
from meshctl.apply.stale_stations import (
    CAUGHT_UP,
    GONE,
    MAX_QUERIED,
    LoginPlace,
    StationEntry,
    inventory_login,
    reconnect_script,
)
from meshctl.device.errors import Timeout
from meshctl.device.observation import Observation
from meshctl.device.ssh import SshConnection
from meshctl.errors import NodeError, Unreachable
from meshctl.fleet import Event, EventKind, Interrupt, Observer, silent
from meshctl.fleet.journal import LastKnown
from meshctl.model import Fleet, Node
from meshctl.nodes.collect import FleetObservation, collect, known_macs
from meshctl.nodes.connections import ConnectionPool
from meshctl.nodes.slots import nodes_in_work
from meshctl.topology import mesh_macs

# A neighbor on the air sends several times a second.
HEARD_MS = 2000
QUERY_TIMEOUT_S = 30.0
# A login that is not answered, and an echo request.
ENTRY_TIMEOUT_S = 5.0
# A minute, or twice that on a slow processor (docs/facts/openwrt-checked.md).
CATCH_UP_TIMEOUT_S = 150.0
# For at most so many neighbors a holder sends until their numbers have caught up.
MAX_CAUGHT_UP = 3
INTERRUPT_LOOK_S = 0.2
# Then the neighbor learns the node from its next beacon, and the operator's machine its MAC: after three ARP requests
# without an answer, Linux waits 3 s.
RELEARN_S = 5.0


@dataclass(frozen=True, slots=True)
class Reconnected:
    """Nodes that may be reachable now, and what was done, for the operator."""

    nodes: frozenset[str] = frozenset()
    notes: tuple[str, ...] = ()


def reconnect(
    connections: ConnectionPool,
    fleet: Fleet,
    observed: FleetObservation,
    owners: Mapping[str, str],
    *,
    interrupt: Interrupt,
    observer: Observer = silent,
) -> Reconnected:
    """Have the neighbors of unreachable nodes repair their links to them. `owners`: MAC -> node.

    The first interrupt closes the connections, since it takes minutes and changes nothing that must be finished.
    """
    asked = entries_of_unreachable(observed, owners)
    if not asked:
        return Reconnected()
    in_use: list[SshConnection] = []
    logins = {mac: _logins(fleet.nodes[name], connections) for mac, name in owners.items() if name in fleet.nodes}

    def ask(holder: str) -> str | None:
        entries = asked[holder]
        script = reconnect_script(entries, caught_up=MAX_CAUGHT_UP, logins=logins)
        checks = sum(len(logins.get(entry.mac.lower(), ())) or 1 for entry in entries)
        timeout_s = QUERY_TIMEOUT_S + ENTRY_TIMEOUT_S * checks
        timeout_s += CATCH_UP_TIMEOUT_S * min(len(entries), MAX_CAUGHT_UP)
        doing = f"repairs its links to nodes that do not answer (at most {timeout_s:.0f} s)"
        observer(Event(EventKind.STEP, holder, time.time(), doing))
        try:
            with connections.borrow(fleet.nodes[holder]) as connection:
                in_use.append(connection)
                if interrupt.stopping:
                    # this connection may have come too late to be closed below
                    return None
                return connection.run(script, timeout_s=timeout_s).stdout
        except NodeError:
            return None
        finally:
            observer(Event(EventKind.FINISHED, holder, time.time()))

    with ThreadPoolExecutor(len(asked), thread_name_prefix="reconnect") as pool:
        answers = {holder: pool.submit(ask, holder) for holder in asked}
        while wait(answers.values(), INTERRUPT_LOOK_S).not_done and not interrupt.stopping:
            pass
        if interrupt.stopping:
            for connection in in_use:
                connection.close()
        return repaired(
            {name: answer.result() for name, answer in answers.items()}, asked, observed.unreachable, owners
        )


def open_repaired(
    connections: ConnectionPool,
    fleet: Fleet,
    node: Node,
    known: Mapping[str, LastKnown],
    *,
    interrupt: Interrupt,
    observer: Observer = silent,
) -> tuple[SshConnection, tuple[str, ...]]:
    """A connection to a node that is to be changed, and notes: if it is unreachable, once those of its mesh that hear
    it have repaired their links to it. Raises what `ssh.connect` raises."""
    try:
        return connections.open(node), ()
    except Unreachable as error:
        is_silent = isinstance(error, Timeout) and error.is_server_silent
        if interrupt.stopping or is_silent:
            raise
        observer(Event(EventKind.STEP, node.name, time.time(), "unreachable: its neighbors look at their links to it"))
        others = [
            other
            for other in fleet.managed()
            if other.name != node.name and other.site == node.site and {*other.meshes} & {*node.meshes}
        ]
        seen = collect(connections, others, parallel=nodes_in_work(fleet.apply.parallel), interrupt=interrupt)
        observed = replace(seen, unreachable={node.name: str(error)})
        done = reconnect(connections, fleet, observed, known_macs(fleet, known), interrupt=interrupt)
        if node.name not in done.nodes or interrupt.stopping:
            raise
        interrupt.wait(RELEARN_S)
    return connections.open(node), done.notes


def _logins(node: Node, connections: ConnectionPool) -> tuple[LoginPlace, ...]:
    """Where a node may accept logins: according to the inventory, and where it was last seen, if that differs."""
    former = connections.former_places().get(node.name)
    seen = () if former is None else (LoginPlace(str(former.address), former.port),)
    return tuple(dict.fromkeys((inventory_login(node), *seen)))


def reach_behind(run_context: RunContext, node: str, now: Observation, names: Iterable[str]) -> frozenset[str]:
    """Have a node that has rebooted repair its links to these neighbors, which drop its frames: those behind it are
    reached by no other. Returns the nodes that may be reachable now."""
    if run_context.interrupt.stopping:
        return frozenset()
    observed = FleetObservation({node: now}, dict.fromkeys(names, ""), {})
    owners = run_context.current_mac_owners()
    interrupt, observer = run_context.interrupt, run_context.observer
    done = reconnect(
        run_context.connections, run_context.fleet, observed, owners, interrupt=interrupt, observer=observer
    )
    for note in done.notes:
        run_context.note(note)
    return done.nodes


def repaired(
    answers: Mapping[str, str | None],
    asked: Mapping[str, Iterable[StationEntry]],
    unreachable: Iterable[str],
    owners: Mapping[str, str],
) -> Reconnected:
    """The holders' results. One that has not answered may have done its part and lost its own link meanwhile,
    if it has restarted: its nodes are tried again, too. Pure."""
    without_mac = set(unreachable) - set(owners.values())
    by_text: dict[tuple[str, str], list[str]] = {}
    nodes: set[str] = set()
    for holder, answer in answers.items():
        lost = asked[holder] if answer is None else ()
        # a node may print anything
        macs = {entry.mac.lower() for entry in asked[holder]}
        done = [line.partition(" ") for line in (answer or "").splitlines()]
        for word, mac in (*((word, mac) for word, _, mac in done), *((_LOST, entry.mac) for entry in lost)):
            if word not in _TEXTS or mac.lower() not in macs:
                continue
            owner = owners.get(mac.lower())
            nodes |= without_mac if owner is None else {owner}
            who = f"{mac}, a radio of an unknown node" if owner is None else owner
            holders = by_text.setdefault((who, _TEXTS[word]), [])
            if holder not in holders:
                holders.append(holder)
    notes = tuple(f"{who}: {', '.join(holders)} {text}" for (who, text), holders in by_text.items())
    return Reconnected(frozenset(nodes), notes)


_LOST = "no answer"
_TEXTS = {
    GONE: "removed a stale entry of its radio",
    CAUGHT_UP: "sent echo requests until it no longer dropped them (the sender's radio had restarted)",
    _LOST: "hears it, and did not answer when asked to repair the link",
}


def entries_of_unreachable(
    fleet_observation: FleetObservation, owners: Mapping[str, str]
) -> dict[str, list[StationEntry]]:
    """Holder -> its entries of radios that it hears now and that belong to unreachable nodes. An unknown MAC may
    be that of an unreachable node without a known one; a stranger's radio, which takes no part in the mesh, answers no
    echo request either way, and is left alone.

    A node whose SSH server accepts connections and stays silent is left alone, too: a stale entry drops what accepts
    them, and removing one that is not stale would cut the node off."""
    observed = {mac for observation in fleet_observation.observations.values() for mac in mesh_macs(observation)}
    away = set(fleet_observation.unreachable) - fleet_observation.silent_servers
    is_any_unknown = bool(away - set(owners.values()))
    found: dict[str, list[StationEntry]] = {}
    for holder, observation in fleet_observation.observations.items():
        for station in observation.stations or ():
            mac = station.mac.lower()
            if station.inactive_ms is None or station.inactive_ms >= HEARD_MS or mac in observed:
                continue
            is_away = owners[mac] in away if mac in owners else is_any_unknown
            if is_away and (holder in found or len(found) < MAX_QUERIED):
                found.setdefault(holder, []).append(StationEntry(holder, station.ifname, station.mac))
    return found


def last_relays(names: Iterable[str], known: Mapping[str, LastKnown]) -> Iterator[str]:
    """The relays of the paths over which these nodes last reached their base."""
    for name in names:
        passed = {name}
        while name in known and (via := known[name].facts.get("via", "")) and via not in passed:
            passed.add(via)
            yield via
            name = via
