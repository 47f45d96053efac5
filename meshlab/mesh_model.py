"""The mesh model: the state of the nodes' radios -> neighbors, routes, and the tables of each node's batman-adv.

air/effective of each node -> EffectiveState -> edges (both interfaces up, same cell, link up) -> routes -> air/heard

Pure: the supervisor reads and writes the files, and recomputes whenever one of them or a link changes. A route's
quality is the product of its links' TQ, less a hop penalty, as in BATMAN_IV; BATMAN_V gets the same figures.
"""

from __future__ import annotations

import heapq
import itertools
import zlib
from collections.abc import Callable, Container, Iterable, Iterator, Mapping
from dataclasses import dataclass
from ipaddress import IPv4Interface, IPv4Network

from meshlab.quality import TQ_MAX
from meshlab.spec import LinkSpec

# batman-adv's default hop_penalty, on its scale of TQ
HOP_PENALTY = 30
# the highest rate of two streams in 20 MHz with short guard interval, MCS 15
_BEST_RATE_MBIT_S = 144.4
# transmissions of a unicast frame (docs/lab.md, "Links")
_ATTEMPTS = 7


@dataclass(frozen=True, slots=True)
class WirelessInterface:
    """A wireless interface that is up: the settings that two of them must share to hear each other, and its MAC.

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
    # the kernel's interface index: it changes when the interface is recreated
    index: int = 0

    @property
    def medium(self) -> tuple[str, int, str, str, str, str]:
        return (self.mode, self.frequency_mhz, self.ssid, self.bssid.lower(), self.algorithm, self.key)

    def hears(self, other: WirelessInterface) -> bool:
        return self.medium == other.medium

    def routes_with(self, other: WirelessInterface) -> bool:
        """Whether both belong to a batman-adv interface with the same routing algorithm; IV and V are incompatible."""
        return self.soft != "-" and other.soft != "-" and self.routing == other.routing


@dataclass(frozen=True, slots=True)
class Address:
    """An IPv4 address of a node; whether its device is bridged with the mesh, and with a LAN port.

    `admitted`: the loaded firewall accepts new SSH connections on it; established ones are not affected.
    """

    interface: str
    device: str
    address: str
    prefix: int
    over_mesh: bool
    over_wire: bool
    admitted: bool = True

    @property
    def network(self) -> IPv4Network:
        return IPv4Interface(f"{self.address}/{self.prefix}").network


@dataclass(frozen=True, slots=True)
class StaticRoute:
    """A route of a node to `target` through `gateway`, which is reached over the device `interface`."""

    interface: str
    target: IPv4Network
    gateway: str


@dataclass(frozen=True, slots=True)
class EffectiveState:
    """A node's current interfaces, addresses and routes, as its netifd stand-in wrote them, and the devices between
    which the loaded firewall forwards."""

    interfaces: tuple[WirelessInterface, ...] = ()
    addresses: tuple[Address, ...] = ()
    routes: tuple[StaticRoute, ...] = ()
    forwards: frozenset[tuple[str, str]] = frozenset({("*", "*")})

    def holds(self, address: str, *, over: str) -> bool:
        """Whether the node answers at `address` to packets that arrive over the `mesh` or a `wire`."""
        return any(
            own.address == address and (own.over_mesh if over == "mesh" else own.over_wire) for own in self.addresses
        )

    def admits(self, address: str) -> bool:
        """Whether the firewall accepts a new SSH connection to `address`."""
        return any(own.address == address and own.admitted for own in self.addresses)

    @property
    def bridges_lan_and_mesh(self) -> bool:
        return any(address.over_mesh and address.over_wire for address in self.addresses)

    @property
    def routes_lan_and_mesh(self) -> bool:
        """Whether a computer on its wire reaches the mesh through it, at another address and through its firewall."""
        return any(self.forwards & {(lan.device, mesh.device), ("*", "*")} for lan, mesh in self._routed())

    def answers_through(self, base: EffectiveState) -> bool:
        """Whether replies to a computer on the wire of the router `base` find back to it."""
        return any(
            lan.network == route.target and mesh.address == route.gateway
            for lan, mesh in base._routed()
            for route in self.routes
        )

    def _routed(self) -> Iterator[tuple[Address, Address]]:
        """The pairs of an address on a wire only and one on the mesh only."""
        wired = [address for address in self.addresses if address.over_wire and not address.over_mesh]
        meshed = [address for address in self.addresses if address.over_mesh and not address.over_wire]
        return itertools.product(wired, meshed)


@dataclass(frozen=True, slots=True)
class Edge:
    """`own` hears `peer` of `node`; `tq` (0..255) is the quality of sending to it, 0 when it hears nothing."""

    own: WirelessInterface
    peer: WirelessInterface
    node: str
    link: LinkSpec
    tq: int


@dataclass(frozen=True, slots=True)
class Route:
    """The best route from one node to another: end-to-end TQ, first hop, its links, and each hop with its sender."""

    tq: int
    first: Edge
    links: tuple[LinkSpec, ...]
    hops: tuple[tuple[str, Edge], ...] = ()


def parse_effective(text: str) -> EffectiveState:
    """Parse air/effective: lines of `cell`, `addr`, `route` and `forward`, tab-separated (node_root/lab/netifd.awk,
    admitted.awk)."""
    interfaces, addresses, routes, forwards = [], [], [], set()
    for line in text.splitlines():
        match line.split("\t"):
            case ["cell", _, interface, mode, frequency, ssid, bssid, algorithm, key, mac, soft, routing, *index]:
                number = int(index[0]) if index else 0
                interfaces.append(
                    WirelessInterface(
                        interface, mode, int(frequency), ssid, bssid, algorithm, key, mac, soft, routing, number
                    )
                )
            case ["addr", interface, device, address, prefix, over_mesh, over_wire, *admitted]:
                flags = over_mesh == "1", over_wire == "1", admitted != ["0"]
                addresses.append(Address(interface, device, address, int(prefix), *flags))
            case ["route", device, target, prefix, gateway]:
                routes.append(StaticRoute(device, IPv4Network(f"{target}/{prefix}", strict=False), gateway))
            case ["forward", incoming, outgoing]:
                forwards.add((incoming, outgoing))
    return EffectiveState(tuple(interfaces), tuple(addresses), tuple(routes), frozenset(forwards))


def edges(nodes: Mapping[str, EffectiveState], links: Iterable[LinkSpec]) -> dict[str, list[Edge]]:
    """The edges of each node: over links that are up, between interfaces of one cell, unless the loss is 100 %."""
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
                for cell in nodes[own].interfaces
                for peer in nodes[other].interfaces
                if cell.hears(peer)
            )
    return found


def best_routes(graph: Mapping[str, list[Edge]], start: str) -> dict[str, Route]:
    """The best batman-adv route from `start` to every reachable node."""
    best: dict[str, Route] = {}
    count = itertools.count()
    queue: list[tuple[int, int, str, int, tuple[tuple[str, Edge], ...]]] = [(-TQ_MAX, 0, start, next(count), ())]
    settled: set[str] = set()
    while queue:
        negative, _, name, _, hops = heapq.heappop(queue)
        if name in settled:
            continue
        settled.add(name)
        if hops:
            best[name] = Route(-negative, hops[0][1], tuple(edge.link for _, edge in hops), hops)
        for edge in graph.get(name, ()):
            if edge.node in settled or not edge.own.routes_with(edge.peer):
                continue
            tq = -negative * edge.tq // TQ_MAX
            if hops:
                tq = tq * (TQ_MAX - HOP_PENALTY) // TQ_MAX
            if tq > 0:
                # ties: fewer hops, then the name, then the first found, so that tables do not flap
                heapq.heappush(queue, (-tq, len(hops) + 1, edge.node, next(count), (*hops, (name, edge))))
    return best


@dataclass(frozen=True, slots=True)
class StationRow:
    """One row of a station table: since when (Unix time, s), and since when the station is silent (0: it is heard)."""

    interface: str
    mac: str
    signal_dbm: int
    tq: int
    since_s: int
    silent_since_s: int


def heard_text(
    name: str,
    nodes: Mapping[str, EffectiveState],
    graph: Mapping[str, list[Edge]],
    routes: Mapping[str, Route],
    stations: Iterable[StationRow] | None = None,
    passes: Callable[[str, Edge], bool] = lambda name, edge: True,
) -> str:
    """The file air/heard of one node: S stations, N batman neighbors, O originators (read by the stand-ins).

    S interface mac signal_dbm age_ms rate_mbit_s since silent_since; N interface mac age_ms tq arrives;
    O interface mac next_hop tq age_ms best arrives. `arrives` is how many of 1000 unicast frames and their replies get
    through, which batman-adv's broadcasts do not show. `stations`: the node's station table; None: every edge's peer.
    """
    if stations is None:
        stations = (
            StationRow(edge.own.interface, edge.peer.mac, edge.link.signal_at(name), edge.tq, 0, 0)
            for edge in graph.get(name, ())
        )
    lines = []
    for station in stations:
        rate = _BEST_RATE_MBIT_S * station.tq / TQ_MAX
        lines.append(
            f"S\t{station.interface}\t{station.mac}\t{station.signal_dbm}\t{_age_ms(name, station.mac)}\t{rate:.1f}"
            f"\t{station.since_s}\t{station.silent_since_s}"
        )
    for edge in graph.get(name, ()):
        own, peer = edge.own, edge.peer
        if own.routes_with(peer):
            arrives = _delivered_per_mille([(name, edge)], passes)
            lines.append(f"N\t{own.interface}\t{peer.mac}\t{_age_ms(name, peer.mac)}\t{edge.tq}\t{arrives}")
    for target, path in sorted(routes.items()):
        own, hop = path.first.own, path.first.peer.mac
        mac = next(cell.mac for cell in nodes[target].interfaces if cell.soft != "-")
        arrives = _delivered_per_mille(path.hops, passes)
        lines.append(f"O\t{own.interface}\t{mac}\t{hop}\t{path.tq}\t{_age_ms(name, mac)}\t1\t{arrives}")
    return "".join(f"{line}\n" for line in lines)


def servers_text(
    name: str,
    nodes: Mapping[str, EffectiveState],
    graph: Mapping[str, list[Edge]],
    logs_in: Callable[[str, Edge], bool],
    hung: Container[str] = (),
) -> str:
    """The rest of air/heard: L address state, of the SSH servers of the neighbors, for the stand-in of nc: `answers`,
    `refused` by a firewall, `silent`, or `hangs` for a `hung` node, which accepts connections and says nothing."""
    states: dict[str, str] = {}
    for edge in graph.get(name, ()):
        if not edge.own.routes_with(edge.peer):
            continue
        for own in nodes[edge.node].addresses:
            if own.over_mesh and states.get(own.address) != "answers":
                answer = "hangs" if edge.node in hung else "answers"
                states[own.address] = "refused" if not own.admitted else answer if logs_in(name, edge) else "silent"
    return "".join(f"L\t{address}\t{state}\n" for address, state in states.items())


def _delivered_per_mille(hops: Iterable[tuple[str, Edge]], passes: Callable[[str, Edge], bool]) -> int:
    """How many of 1000 unicast frames over the hops are answered."""
    share = 1.0
    for name, edge in hops:
        if not passes(name, edge):
            return 0
        # 802.11 transmits a unicast frame up to seven times
        if edge.link.loss or edge.link.loss_back:
            for end in (edge.link.a, edge.link.b):
                share *= 1 - edge.link.loss_to(end) ** _ATTEMPTS
    return round(1000 * share)


def _age_ms(name: str, mac: str) -> int:
    # below one originator interval, and stable: nothing depends on it
    return 20 + zlib.crc32(f"{name}{mac}".encode()) % 900
