"""Station tables: the entries of each radio, and the unicast frames that are dropped because of stale entries.

edges, and the instance of each interface -> `StationTables.update` -> entries (since when, silent since when), and
the pairs of interfaces of which one drops the other's unicast frames

A radio numbers its unicast frames to each station. A recreated interface starts at 0; a neighbor that still has the old
entry for the same address keeps the old receive window and drops the frames (docs/lab.md, "What only real radios
showed"). Broadcasts are not numbered that way, so batman-adv does not notice. Likewise, a radio that deletes the entry
of a station which did not restart numbers its own frames to it from 0. Each traffic class has numbers of its own, and
is dropped only if the old entry has seen enough of it. Pure: reads no clock.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum

from meshlab.mesh_model import Edge

# a silent ad-hoc station expires after this (IEEE80211_IBSS_INACTIVITY_LIMIT, net/mac80211)
EXPIRY_S = 60.0
# the time until a sender's numbers catch up: "six minutes later still dead" was recorded, the end never was
DEAF_S = 600.0


class TrafficClass(Enum):
    """dropbear marks its packets AF21, which batman-adv maps to a class of their own; echo requests, their replies and
    packets to a server are ordinary (docs/facts/node-assumptions.md, 25)."""

    ORDINARY = "ordinary"
    LOGINS = "logins"


@dataclass(frozen=True, slots=True)
class InterfaceInstance:
    """One interface from its creation to its removal: the node, its boot, and the kernel's interface index."""

    node: str
    boot: int
    interface: str
    index: int


@dataclass(frozen=True, slots=True)
class StationEntry:
    """A row of `holder`'s station table: the peer with `mac`, since when (s), and silent since when (None: heard)."""

    holder: InterfaceInstance
    peer: InterfaceInstance
    mac: str
    signal_dbm: int
    tq: int
    since_s: float
    silent_since_s: float | None = None


class StationTables:
    """The station tables of a fleet. `now_s` may be any clock, the same in all calls. `dropped`: the classes of which a
    recreated radio's former neighbors drop its frames."""

    def __init__(self, dropped: Iterable[TrafficClass] = tuple(TrafficClass)) -> None:
        self._dropped = tuple(dropped)
        self._entries: dict[tuple[str, str, str], StationEntry] = {}
        # (sender, receiver) -> class -> until when the receiver drops the sender's unicast frames
        self._deaf_until_s: dict[tuple[InterfaceInstance, InterfaceInstance], dict[TrafficClass, float]] = {}

    def update(self, graph: Mapping[str, Sequence[Edge]], boots: Mapping[str, int], now_s: float) -> None:
        """`graph` has the current edges, `boots` the boot count of each running node."""
        heard = set()
        for name, edges in graph.items():
            for edge in edges:
                own, peer = own_instance(name, boots, edge), peer_instance(boots, edge)
                place = (name, edge.own.interface, edge.peer.mac)
                heard.add(place)
                known = self._entries.get(place)
                if known is None or known.holder != own:
                    known = StationEntry(own, peer, edge.peer.mac, 0, 0, now_s)
                elif known.peer != peer:
                    self._deaf_until_s[peer, own] = dict.fromkeys(self._dropped, now_s + DEAF_S)
                signal_dbm = edge.link.signal_at(name)
                self._entries[place] = replace(known, peer=peer, signal_dbm=signal_dbm, tq=edge.tq, silent_since_s=None)
        for place, entry in list(self._entries.items()):
            if boots.get(entry.holder.node) != entry.holder.boot:
                del self._entries[place]
            elif place not in heard and entry.silent_since_s is None:
                self._entries[place] = replace(entry, silent_since_s=now_s)
            elif entry.silent_since_s is not None and now_s - entry.silent_since_s >= EXPIRY_S:
                del self._entries[place]
                self._deaf_until_s.pop((entry.peer, entry.holder), None)
        self._deaf_until_s = {
            pair: until_s
            for pair, until_s in self._deaf_until_s.items()
            if max(until_s.values()) > now_s and all(boots.get(radio.node) == radio.boot for radio in pair)
        }

    def delete(self, node: str, interface: str, mac: str, now_s: float) -> None:
        """`iw dev INTERFACE station del MAC` on the node; the station's next beacon makes a new entry."""
        entry = self._entries.pop((node, interface, mac), None)
        if entry is None or entry.silent_since_s is not None:
            return
        if self._deaf_until_s.pop((entry.peer, entry.holder), None) is None:
            # the entry was not stale: now the peer drops this node's frames
            self._deaf_until_s[entry.holder, entry.peer] = dict.fromkeys(TrafficClass, now_s + DEAF_S)

    def remove_node(self, node: str) -> None:
        """Drop all entries for the node: it was off for longer than entries last."""
        self._entries = {place: entry for place, entry in self._entries.items() if entry.peer.node != node}

    def entries_of(self, node: str) -> list[StationEntry]:
        """The rows of the node's tables."""
        return [entry for (name, _, _), entry in self._entries.items() if name == node]

    def passes(self, name: str, boots: Mapping[str, int], edge: Edge) -> bool:
        """Whether ordinary unicast frames pass over an edge in both directions."""
        return self._passes(name, boots, edge, TrafficClass.ORDINARY)

    def logs_in(self, name: str, boots: Mapping[str, int], edge: Edge) -> bool:
        """Whether packets to the SSH server of the edge's other end pass over it, and its own packets back."""
        return self._passes(name, boots, edge, TrafficClass.LOGINS)

    def _passes(self, name: str, boots: Mapping[str, int], edge: Edge, answer: TrafficClass) -> bool:
        if not self._deaf_until_s:
            return True
        own, peer = own_instance(name, boots, edge), peer_instance(boots, edge)
        there, back = (self._deaf_until_s.get(pair, {}) for pair in ((own, peer), (peer, own)))
        return TrafficClass.ORDINARY not in there and answer not in back

    def next_change_s(self) -> float | None:
        """The time at which the next entry or drop expires, None when there is none."""
        ends = [entry.silent_since_s + EXPIRY_S for entry in self._entries.values() if entry.silent_since_s is not None]
        deaf = (until_s for of_class in self._deaf_until_s.values() for until_s in of_class.values())
        return min([*ends, *deaf], default=None)


def own_instance(name: str, boots: Mapping[str, int], edge: Edge) -> InterfaceInstance:
    return InterfaceInstance(name, boots.get(name, 0), edge.own.interface, edge.own.index)


def peer_instance(boots: Mapping[str, int], edge: Edge) -> InterfaceInstance:
    return InterfaceInstance(edge.node, boots.get(edge.node, 0), edge.peer.interface, edge.peer.index)
