"""Have a node's neighbours forget its radio when it starts anew, so that they take its frames again.

A radio that starts anew counts its frames from 0. A neighbour goes on with the block acknowledgement window it had and
drops that node's unicast until the numbers have caught up, while broadcasts pass and batman-adv sees a perfect link
(docs/lab.md). Without its station entry it learns the node anew from the next beacon. To forget a node that did *not*
start anew does the same harm the other way round, because the neighbour then counts from 0: so each forgets once.

    observations -> who holds an entry of the node's radios (`entries_of`), who may hold one and did not say so
    (`silent_holders`), and whose way leads through the node (`behind`)
    before the radio goes: what those behind it run, to watch it and to forget it by themselves (`watch_script`)
    silence -> whether to ask the others by now, sparingly (`next_ask_s`), to forget what is older (`forget_script`)

All of it is pure; `forgetting` asks.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from meshctl.device.framing import quoted
from meshctl.device.observation import Observation
from meshctl.plan.radios import EVERY_RADIO, SLACK_S, Radios
from meshctl.topology import NEIGHBOUR_FRESH_MS, mesh_macs

# Asked too early, while the old radio still sends, an entry comes back as it was; asked too late, when the node is
# behind another neighbour by then, nobody is there to ask: so they are asked again while the node is silent, after the
# first pause, then after twice as long each time. A minute is the longest, because that long an ad-hoc cell of Linux
# remembers whom it does not hear (IEEE80211_IBSS_INACTIVITY_LIMIT, net/mac80211/ibss.c).
FIRST_PAUSE_S, LONGEST_PAUSE_S = 10.0, 60.0
# Who watches looks once a second. At first a radio that starts anew is expected, so a short silence is taken for it; a
# neighbour is heard several times a second (beacons, batman-adv's OGMs and those it repeats). If there was none, the
# radio was quicker than that. Later (it goes back, or reboots) only a silence that no bad link makes.
EXPECTED_S, EXPECTED_SILENCE_MS, LATER_SILENCE_MS = 30, 1000, 3000
# More neighbours than any radio here has; bounds what a hostile station table costs.
MOST_ASKED = 16
# What a holder says of an entry that was old enough.
GONE, KEPT = "gone", "kept"
# iw's list of its interfaces, for sh; a name of Linux's holds no blank
_EVERY_INTERFACE = "$(iw dev 2>/dev/null | sed -n 's/^[[:space:]]*Interface //p')"


@dataclass(frozen=True, slots=True)
class Entry:
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


def entries_of(node: str, around: Mapping[str, Observation], radios: Radios = EVERY_RADIO) -> tuple[Entry, ...]:
    """Who of those observed holds a station entry of these radios of `node`, in the order of `around`."""
    if node not in around:
        return ()
    macs = frozenset(radio_macs(around[node], radios))
    return tuple(
        Entry(holder, station.ifname, station.mac)
        for holder, seen in around.items()
        if holder != node
        for station in seen.stations or ()
        if station.mac.lower() in macs
    )


def silent_holders(
    node: str, around: Mapping[str, Observation], names: Mapping[str, str], fellows: Iterable[str]
) -> tuple[str, ...]:
    """Who may hold an entry of `node` and did not tell: those that it hears itself, by the MACs that `names` knows.

    When it hears somebody by no known name, that may be any of its `fellows` whose MACs nobody knows.
    """
    if node not in around:
        return ()
    told = {name: seen for name, seen in around.items() if seen.stations is not None}
    strangers = _heard_by(around[node]) - {mac for seen in told.values() for mac in mesh_macs(seen)}
    named = [names[mac] for mac in sorted(strangers) if mac in names]
    known = frozenset(names.values())
    nameless = [name for name in fellows if name not in known] if strangers - names.keys() else []
    return tuple(name for name in dict.fromkeys((*named, *nameless)) if name != node and name not in told)


def booted_unforgotten_s(node: str, around: Mapping[str, Observation]) -> float | None:
    """When `node` booted (Unix time), if somebody has known a radio of it from before that; None otherwise."""
    own = around.get(node)
    if own is None or own.uptime_s is None:
        return None
    macs = frozenset(mesh_macs(own))
    # whatever was read when, within the time that each answer took
    booted_s = own.asked_at_s - own.uptime_s
    is_known_from_before = any(
        station.connected_s is not None
        and station.mac.lower() in macs
        and seen.answered_at_s - station.connected_s < booted_s - SLACK_S
        for holder, seen in around.items()
        for station in seen.stations or ()
        if holder != node
    )
    return booted_s if is_known_from_before else None


def neighbours_now(seen: Observation, names: Mapping[str, str]) -> tuple[str, ...]:
    """Whom a node hears, by name."""
    return tuple(dict.fromkeys(names[mac] for mac in sorted(_heard_by(seen)) if mac in names))


def _heard_by(seen: Observation) -> frozenset[str]:
    fresh = (one.mac.lower() for one in seen.neighbours or () if one.last_seen_ms <= NEIGHBOUR_FRESH_MS)
    return frozenset((*fresh, *(station.mac.lower() for station in seen.stations or ())))


def by_holder(entries: Iterable[Entry]) -> dict[str, tuple[Entry, ...]]:
    """The entries of each holder, of the first `MOST_ASKED` ones."""
    grouped: dict[str, tuple[Entry, ...]] = {}
    for entry in entries:
        grouped[entry.holder] = (*grouped.get(entry.holder, ()), entry)
    return dict(list(grouped.items())[:MOST_ASKED])


def behind(node: str, around: Mapping[str, Observation], base_macs: Iterable[str]) -> frozenset[str]:
    """The nodes whose best way to the base leads through `node` first: while it is not heard, they are out of reach."""
    if node not in around:
        return frozenset()
    own, bases = frozenset(mesh_macs(around[node])), frozenset(mac.lower() for mac in base_macs)
    return frozenset(
        name
        for name, seen in around.items()
        for entry in seen.originators or ()
        if name != node and entry.best and entry.mac.lower() in bases and entry.next_hop.lower() in own
    )


def forget_script(entries: Iterable[Entry], *, older_than_s: float) -> str:
    """POSIX sh that removes those of a holder's entries that were made before the radio started anew, so long ago.

    It prints `gone MAC` for each that it removed, and `kept MAC` for one that it could not.
    """
    return "".join(
        f"for dev in {quoted(entry.ifname) if entry.ifname else _EVERY_INTERFACE}; do "
        f'age=$({_told(entry, "connected time")}); [ "${{age:-0}}" -ge {math.ceil(older_than_s)} ] || continue; '
        f'if iw dev "$dev" station del {quoted(entry.mac)} 2>/dev/null; then echo {GONE} {quoted(entry.mac)}; '
        f"else echo {KEPT} {quoted(entry.mac)}; fi; done\n"
        for entry in entries
    )


def watch_script(node: str, entries: Iterable[Entry], *, for_s: float) -> str:
    """POSIX sh that starts a process of the holder's own, which removes each entry when it falls silent, `for_s` long.

    It takes the place of one that watches `node` already.
    """
    steps = []
    for number, entry in enumerate(entries):
        steps += [
            f"dev={quoted(entry.ifname)}; age=$({_told(entry, 'inactive time')})",
            f'if [ "${{age:-0}}" -ge $limit ] || [ "$late/$did{number}" = 1/ ]; '
            f'then iw dev "$dev" station del {quoted(entry.mac)}; did{number}=1; fi',
        ]
    firsts = " ".join(f"did{number}=" for number in range(len(steps) // 2))
    loop = "; ".join(
        (
            f"{firsts} at=0",
            f"while [ $at -lt {math.ceil(for_s)} ]",
            f"do sleep 1; at=$((at + 1)) late= limit={EXPECTED_SILENCE_MS}",
            f"[ $at -lt {EXPECTED_S} ] || limit={LATER_SILENCE_MS}",
            f"[ $at != {EXPECTED_S} ] || late=1",
            *steps,
            "done",
        )
    )
    pid_file = quoted(f"/tmp/meshctl/forget.{node}.pid")
    return (
        f"mkdir -p /tmp/meshctl; [ ! -f {pid_file} ] || kill $(cat {pid_file}) 2>/dev/null; rm -f {pid_file}\n"
        f"start-stop-daemon -S -q -b -m -p {pid_file} -x /bin/sh -- -c {quoted(loop)} && echo watching\n"
    )


def _told(entry: Entry, word: str) -> str:
    """POSIX sh that prints the number iw has behind `word` for the entry on interface $dev."""
    return (
        f"iw dev \"$dev\" station get {quoted(entry.mac)} 2>/dev/null | sed -n 's/.*{word}:[^0-9]*\\([0-9]*\\).*/\\1/p'"
    )


def next_ask_s(asked_s: Sequence[float]) -> float:
    """When those around a silent node are asked next, after they were at `asked_s` (seconds of one clock)."""
    if not asked_s:
        return float("-inf")
    pause_s: float = FIRST_PAUSE_S * 2 ** (len(asked_s) - 1)
    return asked_s[-1] + min(pause_s, LONGEST_PAUSE_S)
