"""Reach nodes that are back in their mesh, but whose unicast frames a neighbor drops.

A node that rebooted within a minute numbers its frames from 0 again, and each neighbor that still has its station entry
drops them until the numbers have caught up: batman-adv hears it, logins time out for minutes (docs/lab.md). `reconnect`
has the neighbors that hear such a node remove their entries if they are stale, which they verify (`stale_stations`).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor

from meshctl.apply.stale_stations import GONE, MAX_QUERIED, StationEntry, flush_script
from meshctl.errors import NodeError
from meshctl.fleet.journal import LastKnown
from meshctl.model import Fleet
from meshctl.nodes.collect import FleetObservation
from meshctl.nodes.connections import ConnectionPool

# A neighbor on the air sends several times a second.
HEARD_MS = 2000
# Each entry costs its holder up to 3 s.
QUERY_TIMEOUT_S = 30.0
# Then the neighbor learns the node from its next beacon, and the operator's machine its MAC: after three ARP requests
# without an answer, Linux waits 3 s.
RELEARN_S = 5.0


def reconnect(
    connections: ConnectionPool, fleet: Fleet, seen: FleetObservation, owners: Mapping[str, str]
) -> dict[str, tuple[str, ...]]:
    """Unreachable node -> neighbors that removed a stale entry of one of its radios. `owners`: MAC -> node."""
    asked = entries_of_unreachable(seen, owners)
    if not asked:
        return {}

    def ask(holder: str) -> str:
        script = flush_script(asked[holder], older_than_s=0.0)
        try:
            with connections.borrow(fleet.nodes[holder]) as connection:
                return connection.run(script, timeout_s=QUERY_TIMEOUT_S).stdout
        except NodeError:
            return ""

    found: dict[str, tuple[str, ...]] = {}
    with ThreadPoolExecutor(len(asked), thread_name_prefix="reconnect") as pool:
        for holder, answer in zip(asked, pool.map(ask, asked), strict=True):
            for name in dict.fromkeys(_removed(answer, owners)):
                found[name] = (*found.get(name, ()), holder)
    return found


def _removed(answer: str, owners: Mapping[str, str]) -> Iterator[str]:
    for line in answer.splitlines():
        word, _, mac = line.partition(" ")
        if word == GONE and mac.lower() in owners:
            yield owners[mac.lower()]


def entries_of_unreachable(seen: FleetObservation, owners: Mapping[str, str]) -> dict[str, list[StationEntry]]:
    """Holder -> its entries of radios of unreachable nodes that it hears now."""
    found: dict[str, list[StationEntry]] = {}
    for holder, observation in seen.observations.items():
        for station in observation.stations or ():
            is_heard = station.inactive_ms is not None and station.inactive_ms < HEARD_MS
            if is_heard and owners.get(station.mac.lower()) in seen.unreachable and len(found) < MAX_QUERIED:
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
