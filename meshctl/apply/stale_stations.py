"""Remove stale station entries: those that neighbors hold of a radio that has restarted since.

A radio that restarts counts its frames from 0. A neighbor goes on with the block acknowledgement window it had and
drops that node's unicast until the numbers have caught up, while broadcasts pass and batman-adv sees a perfect link
(docs/lab.md). Without its station entry it learns the node from the next beacon. Removing the entry of a radio that did
*not* restart does the same harm the other way round. So no entry is removed on an assumption: the holder removes it
when it hears the neighbor and gets no answer from it (scripts/stale_station.sh), or, where it has no batman-adv to find
that out, when the node itself was seen to have restarted that radio.

    observations -> who holds an entry of the node's radios (`entries_of`), who may hold one and did not say so
    (`silent_holders`), and whose way leads through the node (`behind`)
    before the radio goes: what those behind it, and the node itself, run to watch their entries (`watch_script`)
    silence -> whether to ask the others by now, sparingly (`next_ask_s`), and what they run (`flush_script`)

All of it is pure; `forgetting` asks.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from meshctl.device.framing import quoted
from meshctl.device.observation import Observation
from meshctl.device.scripts import script
from meshctl.plan.radios import EVERY_RADIO, SLACK_S, Radios
from meshctl.topology import NEIGHBOUR_FRESH_MS, mesh_macs

# A node that is not heard has no stale entry to remove, and one whose radio has just come back is asked about again: so
# they are asked again while the node is silent, after the first pause, then after twice as long each time. A minute is
# the longest, because that long an ad-hoc cell of Linux remembers whom it does not hear
# (IEEE80211_IBSS_INACTIVITY_LIMIT, net/mac80211/ibss.c).
FIRST_PAUSE_S, MAX_PAUSE_S = 5.0, 60.0
# More neighbours than any radio here has; bounds what a hostile station table costs.
MAX_QUERIED = 16
# What a holder says of an entry that was old enough: removed, cannot be removed, not stale, cannot find out.
GONE, KEPT, ANSWERS, UNKNOWN = "gone", "kept", "answers", "unknown"
# iw's list of its interfaces, for sh; a name of Linux's holds no blank
_EVERY_INTERFACE = "\"$(iw dev 2>/dev/null | sed -n 's/^[[:space:]]*Interface //p')\""


@dataclass(frozen=True, slots=True)
class StationEntry:
    """A station entry: node `holder` knows the radio `mac` on its interface `ifname`, on whichever it is when empty."""

    holder: str
    ifname: str
    mac: str


def radio_macs(seen: Observation, radios: Radios) -> tuple[str, ...]:
    """The MACs by which neighbours know these radios of a node, lower case."""
    if radios.every:
        return mesh_macs(seen)
    links = {link.ifname: link.mac.lower() for link in seen.links or ()}
    macs = {ifname: mac.lower() for ifname, mac in (seen.macs or {}).items()} | links
    known = frozenset(mesh_macs(seen))
    return tuple(dict.fromkeys(mac for ifname, mac in macs.items() if ifname in radios and mac in known))


def entries_of(
    node: str, observations: Mapping[str, Observation], radios: Radios = EVERY_RADIO
) -> tuple[StationEntry, ...]:
    """Who of those observed holds a station entry of these radios of `node`, in the order of `around`."""
    if node not in observations:
        return ()
    macs = frozenset(radio_macs(observations[node], radios))
    return tuple(
        StationEntry(holder, station.ifname, station.mac)
        for holder, seen in observations.items()
        if holder != node
        for station in seen.stations or ()
        if station.mac.lower() in macs
    )


def own_entries(node: str, seen: Observation, radios: Radios = EVERY_RADIO) -> tuple[StationEntry, ...]:
    """The entries that the node itself holds, of whomever these radios of it know."""
    own = (
        StationEntry(node, station.ifname, station.mac) for station in seen.stations or () if station.ifname in radios
    )
    return tuple(own)[:MAX_QUERIED]


def possible_holders(
    node: str, observations: Mapping[str, Observation], names: Mapping[str, str], mesh_nodes: Iterable[str]
) -> tuple[str, ...]:
    """Who may hold an entry of `node` and did not tell: those that it hears itself, by the MACs that `names` knows.

    When it hears somebody by no known name, that may be any of its `fellows` whose MACs nobody knows.
    """
    if node not in observations:
        return ()
    observed = {name: seen for name, seen in observations.items() if seen.stations is not None}
    unknown_macs = _heard_macs(observations[node]) - {mac for seen in observed.values() for mac in mesh_macs(seen)}
    named = [names[mac] for mac in sorted(unknown_macs) if mac in names]
    known = frozenset(names.values())
    unnamed = [name for name in mesh_nodes if name not in known] if unknown_macs - names.keys() else []
    return tuple(name for name in dict.fromkeys((*named, *unnamed)) if name != node and name not in observed)


def unflushed_boot_s(node: str, observations: Mapping[str, Observation]) -> float | None:
    """When `node` booted (Unix time), if somebody has known a radio of it from before that; None otherwise."""
    own = observations.get(node)
    if own is None or own.uptime_s is None:
        return None
    macs = frozenset(mesh_macs(own))
    # whatever was read when, within the time that each answer took
    booted_s = own.asked_at_s - own.uptime_s
    is_known_from_before = any(
        station.connected_s is not None
        and station.mac.lower() in macs
        and seen.answered_at_s - station.connected_s < booted_s - SLACK_S
        for holder, seen in observations.items()
        for station in seen.stations or ()
        if holder != node
    )
    return booted_s if is_known_from_before else None


def current_neighbors(seen: Observation, names: Mapping[str, str]) -> tuple[str, ...]:
    """Whom a node hears, by name."""
    return tuple(dict.fromkeys(names[mac] for mac in sorted(_heard_macs(seen)) if mac in names))


def _heard_macs(seen: Observation) -> frozenset[str]:
    fresh = (one.mac.lower() for one in seen.neighbours or () if one.last_seen_ms <= NEIGHBOUR_FRESH_MS)
    return frozenset((*fresh, *(station.mac.lower() for station in seen.stations or ())))


def by_holder(entries: Iterable[StationEntry]) -> dict[str, tuple[StationEntry, ...]]:
    """The entries of each holder, of the first `MOST_ASKED` ones."""
    grouped: dict[str, tuple[StationEntry, ...]] = {}
    for entry in entries:
        grouped[entry.holder] = (*grouped.get(entry.holder, ()), entry)
    return dict(list(grouped.items())[:MAX_QUERIED])


def routed_through(node: str, observations: Mapping[str, Observation], base_macs: Iterable[str]) -> frozenset[str]:
    """The nodes whose best way to the base leads through `node` first: while it is not heard, they are out of reach."""
    if node not in observations:
        return frozenset()
    own, bases = frozenset(mesh_macs(observations[node])), frozenset(mac.lower() for mac in base_macs)
    return frozenset(
        name
        for name, seen in observations.items()
        for entry in seen.originators or ()
        if name != node and entry.best and entry.mac.lower() in bases and entry.next_hop.lower() in own
    )


def flush_script(entries: Iterable[StationEntry], *, older_than_s: float, has_restarted: bool = False) -> str:
    """POSIX sh that removes those of a holder's entries that are at least that old and stale, or, where the radios were
    seen to have restarted, all that are that old.

    It prints a line `gone|kept|answers|unknown MAC` for each that is old enough and whose neighbor is heard.
    """
    verb = "flush_restarted" if has_restarted else "flush_stale"
    calls = [
        f"{verb} {quoted(entry.ifname) if entry.ifname else _EVERY_INTERFACE} {quoted(entry.mac)} "
        f"{math.ceil(older_than_s)}\n"
        for entry in entries
    ]
    return "".join((script("stale_station.sh"), *calls))


def watch_script(node: str, entries: Iterable[StationEntry], *, for_s: float) -> str:
    """POSIX sh that starts a process of the holder's own, which for `for_s` removes those of its entries that become
    stale. It takes the place of one that watches for `node` already."""
    watched = [f"{entry.ifname}/{entry.mac}" for entry in entries]
    loop = f"{script('stale_station.sh')}watch_stale {math.ceil(for_s)} {quoted(*watched)}"
    pid_file = quoted(f"/tmp/meshctl/forget.{node}.pid")
    return (
        f"mkdir -p /tmp/meshctl; [ ! -f {pid_file} ] || kill $(cat {pid_file}) 2>/dev/null; rm -f {pid_file}\n"
        f"start-stop-daemon -S -q -b -m -p {pid_file} -x /bin/sh -- -c {quoted(loop)} && echo watching\n"
    )


def next_query_s(asked_s: Sequence[float]) -> float:
    """When those around a silent node are asked next, after they were at `asked_s` (seconds of one clock)."""
    if not asked_s:
        return float("-inf")
    pause_s: float = FIRST_PAUSE_S * 2 ** (len(asked_s) - 1)
    return asked_s[-1] + min(pause_s, MAX_PAUSE_S)
