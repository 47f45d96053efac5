"""Find stale station entries: those that neighbors hold of a radio that has restarted since. Pure.

A radio that restarts counts its frames from 0. A neighbor keeps its block acknowledgment window and drops that node's
unicast frames until the numbers have caught up, while broadcasts pass and batman-adv sees a perfect link (docs/lab.md).
Without its station entry it learns the node from the next beacon. Removing the entry of a radio that did *not* restart
causes the same loss in the other direction. So the holder of an entry verifies it first: it removes the entry of a
neighbor that it hears and that does not answer it (scripts/stale_station.sh). Where it has no batman-adv to verify
that, it removes the entry only if meshctl observed that the radio restarted. An answer to an echo request does not
show that logins pass, which are of another traffic class. If a node is unreachable although its change cannot drop
logins, or its timer has undone that, or it is away when a run begins, its neighbors also try its SSH server.

    observations -> the holders of entries of a node's radios (`entries_of`), nodes that may hold one
    (`possible_holders`), nodes whose route to the base leads through the node (`routed_through`)
    before the change: the script with which a node watches its entries (`watch_script`)
    while the node is unreachable: when to query its neighbors (`next_query_s`), and what they run (`flush_script`)

`station_flush` runs these scripts over SSH.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from meshctl.device.framing import quoted
from meshctl.device.observation import Observation
from meshctl.device.scripts import script
from meshctl.model import Node
from meshctl.plan.radios import EVERY_RADIO, SLACK_S, Radios
from meshctl.topology import NEIGHBOR_FRESH_MS, mesh_macs

# Neighbors are queried repeatedly while the node is unreachable, because an entry is stale only once the radio is back
# on the air. The pause doubles each time, up to a minute: Linux drops an inactive station of an ad-hoc cell after that
# (IEEE80211_IBSS_INACTIVITY_LIMIT, net/mac80211/ibss.c).
FIRST_PAUSE_S, MAX_PAUSE_S = 5.0, 60.0
# Once its entry is removed, a neighbor is learned again from its next beacon.
RELEARN_S = 3
# More neighbors than any radio here has; bounds the cost of a hostile station table.
MAX_QUERIED = 16
# What a holder prints for an entry that is old enough: removed, cannot be removed, cannot be verified. It prints
# `answers` for one that is not stale.
GONE, KEPT, UNKNOWN = "gone", "kept", "unknown"
# What a holder prints once a neighbor answers it again because the holder has sent enough.
CAUGHT_UP = "caught-up"
# The batman-adv interface of rendered configurations. Its MAC is another after each boot.
_MESH = "bat0"
# all wireless interfaces, for sh; Linux allows no blank in an interface name
_EVERY_INTERFACE = "\"$(iw dev 2>/dev/null | sed -n 's/^[[:space:]]*Interface //p')\""


class LoginPlace(NamedTuple):
    """Address and port of a node's SSH server. `mesh_mac`: of its batman-adv interface before a change that restarts
    no radio. While the mesh announces it, the node has not rebooted, and no entry makes a server silent."""

    address: str
    port: int
    mesh_mac: str = ""


@dataclass(frozen=True, slots=True)
class StationEntry:
    """A station entry of the radio `mac` on interface `ifname` of node `holder`; on any interface when empty."""

    holder: str
    ifname: str
    mac: str


def radio_macs(observation: Observation, radios: Radios) -> tuple[str, ...]:
    """The lower-case MACs by which neighbors know these radios of a node."""
    if radios.is_all:
        return mesh_macs(observation)
    links = {link.ifname: link.mac.lower() for link in observation.links or ()}
    macs = {ifname: mac.lower() for ifname, mac in (observation.macs or {}).items()} | links
    known = frozenset(mesh_macs(observation))
    return tuple(dict.fromkeys(mac for ifname, mac in macs.items() if ifname in radios and mac in known))


def entries_of(
    node: str, observations: Mapping[str, Observation], radios: Radios = EVERY_RADIO
) -> tuple[StationEntry, ...]:
    """The station entries of these radios of `node`, in the order of `observations`."""
    if node not in observations:
        return ()
    macs = frozenset(radio_macs(observations[node], radios))
    return tuple(
        StationEntry(holder, station.ifname, station.mac)
        for holder, observation in observations.items()
        if holder != node
        for station in observation.stations or ()
        if station.mac.lower() in macs
    )


def login_of(node: Node, before: Observation, radios: Radios) -> LoginPlace | None:
    """Where a node's neighbors can log in to it, unless its change, which restarts these radios, gives it another
    address than it had `before`."""
    had = {address.partition("/")[0] for interface in before.interfaces or () for address in interface.addresses}
    login = inventory_login(node)
    if login.address not in had:
        return None
    if radios:
        return login
    return login._replace(mesh_mac=(before.macs or {}).get(_MESH, ""))


def inventory_login(node: Node) -> LoginPlace:
    """Where a node accepts logins according to the inventory."""
    return LoginPlace(str(node.address.ip), node.ssh.port)


def own_entries(node: str, observation: Observation, radios: Radios = EVERY_RADIO) -> tuple[StationEntry, ...]:
    """The entries that the node itself holds on these radios."""
    own = (
        StationEntry(node, station.ifname, station.mac)
        for station in observation.stations or ()
        if station.ifname in radios
    )
    return tuple(own)[:MAX_QUERIED]


def possible_holders(
    node: str, observations: Mapping[str, Observation], names: Mapping[str, str], mesh_nodes: Iterable[str]
) -> tuple[str, ...]:
    """The nodes that may hold an entry of `node` and were not observed: those it hears, by the MACs in `names`.

    A MAC that is not in `names` may belong to any of the `mesh_nodes` without a known MAC.
    """
    if node not in observations:
        return ()
    observed = {name: observation for name, observation in observations.items() if observation.stations is not None}
    unknown_macs = _heard_macs(observations[node]) - {
        mac for observation in observed.values() for mac in mesh_macs(observation)
    }
    named = [names[mac] for mac in sorted(unknown_macs) if mac in names]
    known = frozenset(names.values())
    unnamed = [name for name in mesh_nodes if name not in known] if unknown_macs - names.keys() else []
    return tuple(name for name in dict.fromkeys((*named, *unnamed)) if name != node and name not in observed)


def unflushed_boot_s(node: str, observations: Mapping[str, Observation]) -> float | None:
    """When `node` booted (Unix time), if an observed node holds an older entry of one of its radios; else None."""
    own = observations.get(node)
    if own is None or own.uptime_s is None:
        return None
    macs = frozenset(mesh_macs(own))
    # the earliest boot time and the latest entry time that the answers' durations allow
    booted_s = own.asked_at_s - own.uptime_s
    is_known_from_before = any(
        station.connected_s is not None
        and station.mac.lower() in macs
        and observation.answered_at_s - station.connected_s < booted_s - SLACK_S
        for holder, observation in observations.items()
        for station in observation.stations or ()
        if holder != node
    )
    return booted_s if is_known_from_before else None


def current_neighbors(observation: Observation, names: Mapping[str, str]) -> tuple[str, ...]:
    """The names of the nodes that a node hears."""
    return tuple(dict.fromkeys(names[mac] for mac in sorted(_heard_macs(observation)) if mac in names))


def _heard_macs(observation: Observation) -> frozenset[str]:
    fresh = (
        neighbor.mac.lower() for neighbor in observation.neighbors or () if neighbor.last_seen_ms <= NEIGHBOR_FRESH_MS
    )
    return frozenset((*fresh, *(station.mac.lower() for station in observation.stations or ())))


def by_holder(entries: Iterable[StationEntry]) -> dict[str, tuple[StationEntry, ...]]:
    """The entries of the first `MAX_QUERIED` holders, by holder."""
    grouped: dict[str, tuple[StationEntry, ...]] = {}
    for entry in entries:
        grouped[entry.holder] = (*grouped.get(entry.holder, ()), entry)
    return dict(list(grouped.items())[:MAX_QUERIED])


def routed_through(node: str, observations: Mapping[str, Observation], base_macs: Iterable[str]) -> frozenset[str]:
    """The nodes whose next hop to the base is `node`: they are unreachable while it is."""
    if node not in observations:
        return frozenset()
    own, bases = frozenset(mesh_macs(observations[node])), frozenset(mac.lower() for mac in base_macs)
    return frozenset(
        name
        for name, observation in observations.items()
        for entry in observation.originators or ()
        if name != node and entry.best and entry.mac.lower() in bases and entry.next_hop.lower() in own
    )


def flush_script(
    entries: Iterable[StationEntry],
    *,
    older_than_s: float,
    has_restarted: bool = False,
    login: LoginPlace | None = None,
) -> str:
    """POSIX sh that removes a holder's entries that are at least that old and stale; with `has_restarted` all that are
    that old. `login`: where the entries' node accepts logins, if no other answer of it counts.

    It prints `gone|kept|answers|unknown MAC` for each entry that is old enough and whose neighbor is heard.
    """
    verb = "flush_restarted" if has_restarted else "flush_stale"
    calls = [
        f"{verb} {quoted(entry.ifname) if entry.ifname else _EVERY_INTERFACE} {quoted(entry.mac)} "
        f"{math.ceil(older_than_s)}{_where(login)}\n"
        for entry in entries
    ]
    return "".join((script("stale_station.sh"), *calls))


def _where(login: LoginPlace | None) -> str:
    if login is None:
        return ""
    announced = f" {quoted(login.mesh_mac)}" if login.mesh_mac else ""
    return f" {quoted(login.address)} {login.port}{announced}"


def reconnect_script(
    entries: Sequence[StationEntry], *, caught_up: int, logins: Mapping[str, Sequence[LoginPlace]]
) -> str:
    """POSIX sh that repairs a holder's links to these neighbors: it removes stale entries, then sends to the first
    `caught_up` of those that still do not answer. It prints a line for each of both. `logins`: lower-case MAC -> where
    its node may accept logins; an address that no device has shows nothing."""
    words = [(quoted(entry.ifname), quoted(entry.mac)) for entry in entries]
    flushes = [
        f"flush_stale {ifname} {mac} 0{_where(login)}\n"
        for (ifname, mac), entry in zip(words, entries, strict=True)
        for login in logins.get(entry.mac.lower()) or (None,)
    ]
    sends = [f"catch_up {ifname} {mac}\n" for ifname, mac in words[:caught_up]]
    return "".join((script("stale_station.sh"), *flushes, f"pause {RELEARN_S}\n", *sends))


def watch_script(node: str, entries: Iterable[StationEntry], *, for_s: float, ends_when_confirmed: bool = False) -> str:
    """POSIX sh that starts a background process on the holder, which for `for_s` removes those of its entries that
    become stale. It replaces a process that already watches for `node`. `ends_when_confirmed`: the holder is `node`,
    and its own change is the only one."""
    watched = [f"{entry.ifname}/{entry.mac}" for entry in entries]
    pid_file = quoted(f"/tmp/meshctl/forget.{node}.pid")
    own = "IS_OWN=yes " if ends_when_confirmed else ""
    loop = f"{script('stale_station.sh')}{own}watch_stale {math.ceil(for_s)} {quoted(*watched)}\nrm -f {pid_file}"
    # the process id of a killed watch stays, and may be another process's by now
    return (
        f"mkdir -p /tmp/meshctl; pid=$(cat {pid_file} 2>/dev/null); rm -f {pid_file}\n"
        '[ -z "$pid" ] || ! grep -q watch_stale "/proc/$pid/cmdline" 2>/dev/null || kill "$pid"\n'
        f"start-stop-daemon -S -q -b -m -p {pid_file} -x /bin/sh -- -c {quoted(loop)} && echo watching\n"
    )


def next_query_s(asked_s: Sequence[float]) -> float:
    """When to query the neighbors of an unreachable node again, after queries at `asked_s` (monotonic seconds)."""
    if not asked_s:
        return float("-inf")
    pause_s: float = FIRST_PAUSE_S * 2 ** (len(asked_s) - 1)
    return asked_s[-1] + min(pause_s, MAX_PAUSE_S)
