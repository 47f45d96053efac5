"""The links of one robot for the placement meter: a snapshot a second, over kept connections.

`LinkPoller` queries the robot's own radios, and in turn one of the nodes that it hears or that its path uses, for the
other direction and the hops behind. Radios are queried in threads: one that does not answer delays no snapshot, and
counts as silent. `assemble` (pure) makes a `LinkSnapshot` of their tables.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Container, Iterable, Mapping
from dataclasses import dataclass, field, replace

from meshctl.device.link_table import LinkTable, read_links
from meshctl.errors import MeshctlError
from meshctl.model import Fleet, Node
from meshctl.nodes.connections import ConnectionPool
from meshctl.placement.margin import (
    RACK_DBM,
    UNMEASURED_FADE_DB,
    Sample,
    fade_allowance_db,
    filtered_snr_db,
    worse_snr_db,
)
from meshctl.placement.meter import LinkSnapshot, PathBeyond, Position, RelayLink

QUERY_S = 3.0
DROPPED_DB = 15
"""Between the rack, within a meter, and some meters behind the robot; less than turning the robot changes nothing."""
MAX_TABLE_AGE_S = 30.0
"""An older table of a relay says nothing: it may have moved or died."""
MAX_PATH_HOPS = 32
_KEPT_SAMPLES = 60


@dataclass(frozen=True, slots=True)
class MeshTables:
    """The newest table of each node, whose MACs are whose, the radios of the robot, and the base's node. `aboard`: the
    beacons in the robot's rack that are on, which are no relays."""

    tables: Mapping[str, LinkTable]
    names: Mapping[str, str]
    own: tuple[str, ...]
    base: str
    aboard: frozenset[str] = frozenset()

    def heard_dbm(self) -> dict[str, int]:
        """The best signal of each node that the robot's radios hear."""
        names = dict.fromkeys(name for name in self.names.values() if name not in self.own)
        return {name: found[0] for name in names if (found := _heard(self, name)) is not None}


@dataclass(slots=True)
class Rack:
    """Which carried beacons are on in the robot's rack: those that it hears strongly from the beginning. Pure.

    One is dropped when it is marked as deployed, or heard more weakly than ever before by `DROPPED_DB`. One that is
    switched on as it is dropped is heard later, and never counts as aboard.
    """

    _strongest_dbm: dict[str, int] | None = None

    def aboard(self, heard_dbm: Mapping[str, int], carried: Container[str]) -> frozenset[str]:
        """The beacons aboard, of those that the inventory has as `carried`, at what the robot hears now."""
        if self._strongest_dbm is None:
            if not heard_dbm:
                return frozenset()
            self._strongest_dbm = {name: dbm for name, dbm in heard_dbm.items() if dbm >= RACK_DBM}
        for name, strongest_dbm in tuple(self._strongest_dbm.items()):
            now_dbm = heard_dbm.get(name, strongest_dbm)
            if name not in carried or now_dbm < strongest_dbm - DROPPED_DB:
                del self._strongest_dbm[name]
            else:
                self._strongest_dbm[name] = max(now_dbm, strongest_dbm)
        return frozenset(self._strongest_dbm)


@dataclass(slots=True)
class HopMargins:
    """The margins of the hops behind the robot, with the fading that their tables have shown. Pure."""

    required_snr_db: float
    _samples: dict[tuple[str, str], deque[Sample]] = field(default_factory=dict)

    def of(self, mesh: MeshTables, node: str, to: str) -> tuple[float, float] | None:
        """Margin and SNR of the hop from `node` to `to`; None if neither has reported it lately."""
        here, there = signal_of(mesh, node, to), signal_of(mesh, to, node)
        known = here or there
        if known is None:
            return None
        snr_db = worse_snr_db(known[0], known[1], *(there if here and there else (None, None)))
        taken_s = max(mesh.tables[name].taken_s for name in (node, to) if name in mesh.tables)
        kept = self._samples.setdefault((node, to), deque(maxlen=_KEPT_SAMPLES))
        if not kept or taken_s > kept[-1].at_s:
            kept.append(Sample(taken_s, snr_db, 0.0))
        samples = tuple(kept)
        fade_db = fade_allowance_db(samples) if len(samples) > 1 else UNMEASURED_FADE_DB
        filtered_db = filtered_snr_db(samples)
        return filtered_db - self.required_snr_db - fade_db, filtered_db


def signal_of(mesh: MeshTables, hearer: str, heard: str) -> tuple[int, int | None] | None:
    """The best signal and its noise at which one node hears another, as its table has it."""
    table = mesh.tables.get(hearer)
    if table is None:
        return None
    found = [(dbm, table.noise_dbm.get(mac)) for mac, dbm in table.signals_dbm.items() if mesh.names.get(mac) == heard]
    return max(found, key=lambda reading: reading[0], default=None)


def assemble(
    mesh: MeshTables,
    margins: HopMargins,
    now_s: float,
    *,
    fresh: bool,
    position: Position | None = None,
    heading_rad: float | None = None,
    beacons: int | None = None,
    spacing_m: float | None = None,
) -> LinkSnapshot:
    """`fresh`: the robot's table is newer than that of the last snapshot; an old one has no new samples."""
    links, paths, next_hop = [], {}, ""
    heard = {
        name: found
        for name in dict.fromkeys(mesh.names.values())
        if name not in mesh.own and name not in mesh.aboard and (found := _heard(mesh, name)) is not None
    }
    for name, (dbm, noise_dbm) in heard.items():
        back = max((reading for own in mesh.own if (reading := signal_of(mesh, name, own))), default=(None, None))
        links.append(RelayLink(name, dbm, noise_dbm, *back))
        beyond = path_beyond(mesh, margins, name)
        if beyond is not None:
            paths[name] = beyond
    for own in mesh.own:
        table = mesh.tables.get(own)
        if table is not None and table.next_hop:
            next_hop = mesh.names.get(table.next_hop, "")
            # the hop that matters is the one from the robot to what stays behind
            next_hop = "" if next_hop in mesh.aboard else next_hop
    return LinkSnapshot(
        now_s,
        tuple(links) if fresh else (),
        paths,
        position,
        next_hop=next_hop,
        heading_rad=heading_rad,
        beacons=beacons,
        spacing_m=spacing_m,
    )


def _heard(mesh: MeshTables, name: str) -> tuple[int, int | None] | None:
    return max(
        (found for own in mesh.own if (found := signal_of(mesh, own, name)) is not None),
        key=lambda reading: reading[0],
        default=None,
    )


def path_beyond(mesh: MeshTables, margins: HopMargins, relay: str) -> PathBeyond | None:
    """The way from a relay to the base by the nodes' own next hops; None if it has none, or if it leads through the
    robot itself or its rack. For a relay that has not been queried yet, one hop at least."""
    found: list[tuple[float, float]] = []
    node, hops = relay, 0

    def path() -> PathBeyond:
        margin_db, snr_db = (min((reading[part] for reading in found), default=None) for part in (0, 1))
        return PathBeyond(hops, margin_db, snr_db)

    while node != mesh.base:
        table = mesh.tables.get(node)
        if table is None:
            hops += 1
            return path()
        after = mesh.names.get(table.next_hop, "")
        if not after or after in mesh.own or after in mesh.aboard or hops >= MAX_PATH_HOPS:
            return None
        hop = margins.of(mesh, node, after)
        if hop is not None:
            found.append(hop)
        node, hops = after, hops + 1
    return path()


@dataclass(slots=True)
class LinkPoller:
    """Queries the radios in threads and keeps their newest tables. Thread-safe; `close` ends the threads' work."""

    fleet: Fleet
    access: ConnectionPool
    own: tuple[Node, ...]
    macs: Mapping[str, str]
    base: str
    clock: Callable[[], float]
    carried: Callable[[], Container[str]] = frozenset
    _rack: Rack = field(default_factory=Rack)
    _tables: dict[str, LinkTable] = field(default_factory=dict)
    _busy: set[str] = field(default_factory=set)
    _problems: dict[str, str] = field(default_factory=dict)
    _turn: int = 0
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def ask(self) -> None:
        """Start the queries of this second: all radios of the robot, and the relay whose turn it is."""
        names = [node.name for node in self.own]
        relays = [name for name in self._relays() if name not in names and name in self.fleet.nodes]
        if relays:
            self._turn += 1
            names.append(relays[self._turn % len(relays)])
        for name in names:
            with self._lock:
                if name in self._busy:
                    continue
                self._busy.add(name)
            threading.Thread(target=self._query, args=(name,), name=f"links-{name}", daemon=True).start()

    def mesh(self) -> MeshTables:
        """The tables that are recent enough."""
        now_s = self.clock()
        with self._lock:
            recent = {name: table for name, table in self._tables.items() if now_s - table.taken_s <= MAX_TABLE_AGE_S}
        mesh = MeshTables(recent, self.macs, tuple(node.name for node in self.own), self.base)
        return replace(mesh, aboard=self._rack.aboard(mesh.heard_dbm(), self.carried()))

    def own_taken_s(self) -> float:
        """When the robot's newest table was taken; 0 before the first."""
        with self._lock:
            return max((self._tables[node.name].taken_s for node in self.own if node.name in self._tables), default=0.0)

    def problem(self) -> str:
        """Why the robot's radios do not answer; empty if one does."""
        with self._lock:
            reasons = [self._problems.get(node.name, "") for node in self.own]
        return "" if not all(reasons) else "; ".join(reasons)

    def _relays(self) -> list[str]:
        """The nodes that the robot hears, and those on their paths, strongest and nearest first."""
        mesh = self.mesh()
        heard = sorted(((dbm, name) for name, dbm in mesh.heard_dbm().items() if name not in mesh.aboard), reverse=True)
        wanted = [name for _, name in heard[:4]]
        for name in tuple(wanted):
            node = name
            for _ in range(MAX_PATH_HOPS):
                table = mesh.tables.get(node)
                node = mesh.names.get(table.next_hop, "") if table is not None else ""
                if not node or node in mesh.own or node in wanted:
                    break
                wanted.append(node)
        return wanted

    def _query(self, name: str) -> None:
        problem = ""
        try:
            with self.access.borrow(self.fleet.nodes[name]) as connection:
                table = read_links(connection, self._base_macs(), timeout_s=QUERY_S, clock=self.clock)
            with self._lock:
                self._tables[name] = table
        except MeshctlError as error:
            problem = str(error).splitlines()[0]
        finally:
            with self._lock:
                self._busy.discard(name)
                self._problems[name] = problem

    def _base_macs(self) -> tuple[str, ...]:
        return tuple(mac for mac, name in self.macs.items() if name == self.base)


def carried_beacons(fleet: Fleet, robot: str) -> int | None:
    """How many beacons the robot still carries according to the inventory; None if it carries none there at all."""
    lists_any = any(name in fleet.nodes for name in fleet.robots[robot].carries)
    return len(fleet.rack(robot)) if lists_any else None


def rack_of(fleet: Fleet, robot: str) -> frozenset[str]:
    """What the robot, or the robot of this node, carries according to the inventory."""
    name = robot if robot in fleet.robots else fleet.nodes[robot].robot if robot in fleet.nodes else ""
    return fleet.rack(name) if name in fleet.robots else frozenset()


def own_radios(fleet: Fleet, robot: str) -> tuple[Node, ...]:
    """The managed radios of a robot; of a name that is a node, that node."""
    if robot in fleet.robots:
        names: Iterable[str] = fleet.robots[robot].nodes
    else:
        names = (robot,)
    return tuple(fleet.nodes[name] for name in names if name in fleet.nodes and fleet.nodes[name].state.is_managed)
