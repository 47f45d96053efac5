"""Whom the radios have in their station tables, and whose unicast frames are dropped because of it.

who hears whom, and which incarnation of each interface -> `Stations.update` -> entries (since when, last heard when),
and the pairs of which one drops what the other sends to it alone

A radio numbers its frames to each station. One whose interface was made anew counts from 0; a neighbour that still has
its old entry, under the same address, goes on with the old window and drops them (docs/lab.md, "What only real radios
showed"). Broadcasts carry no such number, so batman-adv sees nothing of it. Likewise one that deletes the entry of a
station which did not start anew counts its own frames to it from 0. Pure: nothing here reads a clock or sleeps.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from meshlab.mesh_model import Edge

# an ad-hoc station that is not heard is dropped after so long (IEEE80211_IBSS_INACTIVITY_LIMIT, net/mac80211)
EXPIRY_S = 60.0
# how long a sender's numbers take to catch up; "six minutes later still dead" was recorded, the end never
DEAF_S = 600.0


@dataclass(frozen=True, slots=True)
class InterfaceInstance:
    """One interface from its making to its end: the node, its boot, and the kernel's number of the interface."""

    node: str
    boot: int
    interface: str
    index: int


@dataclass(frozen=True, slots=True)
class StationEntry:
    """A line of `holder`'s station table: who is behind `mac`, since when (s), and since when silent (None: heard)."""

    holder: InterfaceInstance
    peer: InterfaceInstance
    mac: str
    signal_dbm: int
    tq: int
    since_s: float
    silent_since_s: float | None = None


class StationTables:
    """The station tables of a fleet. `now_s` is any clock, the same in all calls."""

    def __init__(self) -> None:
        self._entries: dict[tuple[str, str, str], StationEntry] = {}
        # (sender, receiver): until when the receiver drops what the sender sends to it alone
        self._deaf_until_s: dict[tuple[InterfaceInstance, InterfaceInstance], float] = {}

    def update(self, graph: Mapping[str, Sequence[Edge]], boots: Mapping[str, int], now_s: float) -> None:
        """`graph` is who hears whom now, `boots` the count of boots of each node that runs."""
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
                    self._deaf_until_s[peer, own] = now_s + DEAF_S
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
            if until_s > now_s and all(boots.get(radio.node) == radio.boot for radio in pair)
        }

    def delete(self, node: str, interface: str, mac: str, now_s: float) -> None:
        """`iw dev INTERFACE station del MAC` on the node; it is known again from its next beacon on."""
        entry = self._entries.pop((node, interface, mac), None)
        if entry is None or entry.silent_since_s is not None:
            return
        if self._deaf_until_s.pop((entry.peer, entry.holder), None) is None:
            # nothing was wrong: now the other one drops what comes from here
            self._deaf_until_s[entry.holder, entry.peer] = now_s + DEAF_S

    def remove_node(self, node: str) -> None:
        """The node was away for longer than stations are remembered: nobody has it in a table any more."""
        self._entries = {place: entry for place, entry in self._entries.items() if entry.peer.node != node}

    def entries_of(self, node: str) -> list[StationEntry]:
        """The lines of the node's tables."""
        return [entry for (name, _, _), entry in self._entries.items() if name == node]

    def passes(self, name: str, boots: Mapping[str, int], edge: Edge) -> bool:
        """Whether frames to one station pass over an edge, both ways."""
        if not self._deaf_until_s:
            return True
        own, peer = own_instance(name, boots, edge), peer_instance(boots, edge)
        return (own, peer) not in self._deaf_until_s and (peer, own) not in self._deaf_until_s

    def next_change_s(self) -> float | None:
        """When something ends by itself, unless something happens before."""
        ends = [entry.silent_since_s + EXPIRY_S for entry in self._entries.values() if entry.silent_since_s is not None]
        return min([*ends, *self._deaf_until_s.values()], default=None)


def own_instance(name: str, boots: Mapping[str, int], edge: Edge) -> InterfaceInstance:
    return InterfaceInstance(name, boots.get(name, 0), edge.own.interface, edge.own.index)


def peer_instance(boots: Mapping[str, int], edge: Edge) -> InterfaceInstance:
    return InterfaceInstance(edge.node, boots.get(edge.node, 0), edge.peer.interface, edge.peer.index)
