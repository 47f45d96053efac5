"""Who hears whom: what the nodes' radios send, turned into neighbours, paths and what each node's batman-adv knows.

effective text per node -> Effective -> edges (both radios up, same cell, link there) -> best paths -> `heard` text

Pure: the supervisor reads and writes the files, and asks again whenever one of them or a link changes. A path's
quality is the product of its links' TQ, less a hop penalty, as BATMAN_IV has it; the same figures serve BATMAN_V.
"""

from __future__ import annotations

import heapq
import itertools
import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from meshctl.lab.quality import TQ_MAX
from meshctl.lab.spec import LinkSpec

# batman-adv's default hop_penalty, on its scale of TQ
HOP_PENALTY = 30
# the highest rate of two streams in 20 MHz with short guard interval, MCS 15
_BEST_RATE_MBIT_S = 144.4


@dataclass(frozen=True, slots=True)
class Cell:
    """One radio interface that is up: everything that must be equal for two of them to hear each other, and its MAC.

    `soft` is the batman-adv interface it belongs to, `-` for none.
    """

    interface: str
    mode: str
    frequency_mhz: int
    ssid: str
    bssid: str
    algorithm: str
    key: str
    mac: str
    soft: str
    routing: str

    @property
    def medium(self) -> tuple[str, int, str, str, str, str]:
        return (self.mode, self.frequency_mhz, self.ssid, self.bssid.lower(), self.algorithm, self.key)

    def hears(self, other: Cell) -> bool:
        return self.medium == other.medium

    def routes_with(self, other: Cell) -> bool:
        """Both feed a batman-adv of the same routing algorithm; IV and V do not understand each other."""
        return self.soft != "-" and other.soft != "-" and self.routing == other.routing


@dataclass(frozen=True, slots=True)
class Address:
    """An IPv4 address a node has; whether its device is bridged with the mesh, and with a LAN port."""

    interface: str
    address: str
    prefix: int
    over_mesh: bool
    over_wire: bool


@dataclass(frozen=True, slots=True)
class Effective:
    """What a node really does at this moment, as its netifd stand-in wrote it."""

    cells: tuple[Cell, ...] = ()
    addresses: tuple[Address, ...] = ()

    def holds(self, address: str, *, over: str) -> bool:
        """Whether it answers at `address` to packets that come over the `mesh` or a `wire`."""
        return any(
            one.address == address and (one.over_mesh if over == "mesh" else one.over_wire) for one in self.addresses
        )

    @property
    def bridges_lan_and_mesh(self) -> bool:
        return any(one.over_mesh and one.over_wire for one in self.addresses)


@dataclass(frozen=True, slots=True)
class Edge:
    """A cell that hears another, `peer` of `node`; `tq` (0..255) is the quality of sending there, 0 when it is deaf."""

    own: Cell
    peer: Cell
    node: str
    link: LinkSpec
    tq: int


@dataclass(frozen=True, slots=True)
class Path:
    """The best way from one node to another: TQ at its end, first hop, and the links on it."""

    tq: int
    first: Edge
    links: tuple[LinkSpec, ...]


def parse_effective(text: str) -> Effective:
    """The content of air/effective: `cell` and `addr` lines, tab-separated (node_root/lab/netifd.awk)."""
    cells, addresses = [], []
    for line in text.splitlines():
        match line.split("\t"):
            case ["cell", _, interface, mode, frequency, ssid, bssid, algorithm, key, mac, soft, routing]:
                cells.append(Cell(interface, mode, int(frequency), ssid, bssid, algorithm, key, mac, soft, routing))
            case ["addr", interface, _, address, prefix, over_mesh, over_wire]:
                addresses.append(Address(interface, address, int(prefix), over_mesh == "1", over_wire == "1"))
    return Effective(tuple(cells), tuple(addresses))


def edges(nodes: Mapping[str, Effective], links: Iterable[LinkSpec]) -> dict[str, list[Edge]]:
    """Whom each node hears: over links that are up, in a cell they share, unless the link loses everything."""
    found: dict[str, list[Edge]] = {name: [] for name in nodes}
    for link in links:
        if not link.up or link.a not in nodes or link.b not in nodes:
            continue
        for own, other in ((link.a, link.b), (link.b, link.a)):
            if link.loss_to(own) >= 1.0:
                continue
            tq = link.tq_to(other)
            found[own].extend(
                Edge(cell, peer, other, link, tq)
                for cell in nodes[own].cells
                for peer in nodes[other].cells
                if cell.hears(peer)
            )
    return found


def paths(graph: Mapping[str, list[Edge]], start: str) -> dict[str, Path]:
    """The best batman-adv path from `start` to every node it reaches."""
    best: dict[str, Path] = {}
    count = itertools.count()
    queue: list[tuple[int, int, str, int, Edge | None, tuple[LinkSpec, ...]]] = [
        (-TQ_MAX, 0, start, next(count), None, ())
    ]
    settled: set[str] = set()
    while queue:
        negative, hops, name, _, first, links = heapq.heappop(queue)
        if name in settled:
            continue
        settled.add(name)
        if first is not None:
            best[name] = Path(-negative, first, links)
        for edge in graph.get(name, ()):
            if edge.node in settled or not edge.own.routes_with(edge.peer):
                continue
            tq = -negative * edge.tq // TQ_MAX
            if hops:
                tq = tq * (TQ_MAX - HOP_PENALTY) // TQ_MAX
            if tq > 0:
                # equal paths: fewer hops first, then the name, then who was found first, so that tables do not flap
                heapq.heappush(queue, (-tq, hops + 1, edge.node, next(count), first or edge, (*links, edge.link)))
    return best


def heard(name: str, nodes: Mapping[str, Effective], graph: Mapping[str, list[Edge]], ways: Mapping[str, Path]) -> str:
    """The file air/heard of one node: S stations, N batman neighbours, O originators (read by the stand-ins).

    S interface mac signal_dbm age_ms rate_mbit_s; N interface mac age_ms tq; O interface mac next_hop tq age_ms best
    """
    lines = []
    for edge in graph.get(name, ()):
        own, peer = edge.own, edge.peer
        rate, signal_dbm = _BEST_RATE_MBIT_S * edge.tq / TQ_MAX, edge.link.signal_at(name)
        lines.append(f"S\t{own.interface}\t{peer.mac}\t{signal_dbm}\t{_age_ms(name, peer.mac)}\t{rate:.1f}")
        if own.routes_with(peer):
            lines.append(f"N\t{own.interface}\t{peer.mac}\t{_age_ms(name, peer.mac)}\t{edge.tq}")
    for target, path in sorted(ways.items()):
        own, hop = path.first.own, path.first.peer.mac
        mac = next(cell.mac for cell in nodes[target].cells if cell.soft != "-")
        lines.append(f"O\t{own.interface}\t{mac}\t{hop}\t{path.tq}\t{_age_ms(name, mac)}\t1")
    return "".join(f"{line}\n" for line in lines)


def _age_ms(name: str, mac: str) -> int:
    # below one originator interval, and the same at every reading: nothing here depends on it
    return 20 + zlib.crc32(f"{name}{mac}".encode()) % 900
