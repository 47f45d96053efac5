"""The mesh graph from the nodes' reports about their neighbors.

Each reachable node gives a `Report` (its mesh MACs, the neighbors it hears). `heard_by_name` maps the MACs it hears to
nodes, `observed_graph` merges both directions of a link, `seen_by` finds the nodes that still hear an unreachable one.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

from meshctl.topology.graph import Graph, Link, graph_of

# A neighbor not heard for longer is not a link: batman-adv keeps dead ones in its tables for minutes.
NEIGHBOR_FRESH_MS = 10_000


@dataclass(frozen=True, slots=True)
class HeardNeighbor:
    """A neighbor in a node's table: `quality` 0..1, None if unknown. `paths` are the other originators that are reached
    through it: lower-case MAC -> quality of the whole path."""

    mac: str
    last_seen_ms: int
    quality: float | None = None
    signal_dbm: int | None = None
    paths: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Report:
    """One node's view: the MACs of its mesh interfaces, the neighbors it hears (lower-case MACs)."""

    node: str
    macs: tuple[str, ...]
    heard: tuple[HeardNeighbor, ...] = ()


@dataclass(frozen=True, slots=True)
class Sighting:
    """Node `by` heard a node `age_ms` before its report."""

    by: str
    age_ms: int
    signal_dbm: int | None = None


def names_by_mac(reports: Iterable[Report], known_macs: Mapping[str, str]) -> dict[str, str]:
    """MAC -> node name; a node's own report takes precedence over `known_macs` (inventory, last known state)."""
    names = {mac.lower(): name for mac, name in known_macs.items()}
    names.update({mac.lower(): report.node for report in reports for mac in report.macs})
    return names


def heard_by_name(
    report: Report, names: Mapping[str, str], *, fresh_ms: int = NEIGHBOR_FRESH_MS
) -> dict[str, HeardNeighbor]:
    """The neighbors a node hears now: name -> the best of the neighbor's radios, which carries the traffic.

    `names` maps lower-case MACs to nodes; an unknown MAC is its own name. Neighbors not heard for longer than
    `fresh_ms`, and the node's own radios, are left out.
    """
    best: dict[str, HeardNeighbor] = {}
    for heard in report.heard:
        mac = heard.mac.lower()
        name = names.get(mac, mac)
        if heard.last_seen_ms <= fresh_ms and name != report.node:
            measured = _with_quality(heard, name, names)
            known = best.get(name)
            if known is None or _rank(measured) > _rank(known):
                best[name] = measured
    return best


def _with_quality(heard: HeardNeighbor, name: str, names: Mapping[str, str]) -> HeardNeighbor:
    """With the quality of the path to another radio of the same neighbor, where its own is unknown.

    batman-adv may list a node with several radios under the address of its first one only; that path ends here.
    """
    if heard.quality is not None:
        return heard
    paths = [quality for originator, quality in heard.paths.items() if names.get(originator, originator) == name]
    return replace(heard, quality=max(paths, default=None))


def _rank(heard: HeardNeighbor) -> tuple[float, int, int]:
    """By quality, then signal, then how recently it was heard; an unknown value ranks last."""
    quality = -1.0 if heard.quality is None else heard.quality
    # -200 dBm is below any receivable signal
    return quality, -200 if heard.signal_dbm is None else heard.signal_dbm, -heard.last_seen_ms


def observed_graph(
    reports: Iterable[Report],
    *,
    known_macs: Mapping[str, str] | None = None,
    wires: Iterable[tuple[str, str]] = (),
    fresh_ms: int = NEIGHBOR_FRESH_MS,
) -> Graph:
    """The mesh as its nodes report it. `wires` are pairs connected by cable (two radios on a robot's switch).

    A link has the worse quality of its two directions, or that of the only side that reported it. Unknown MACs become
    nodes named by their MAC, so that foreign nodes in the mesh are visible.
    """
    known_reports = tuple(reports)
    names = names_by_mac(known_reports, known_macs or {})
    quality: dict[tuple[str, str], float] = {}
    for report in known_reports:
        for other, heard in heard_by_name(report, names, fresh_ms=fresh_ms).items():
            quality[report.node, other] = 1.0 if heard.quality is None else heard.quality
    links = [Link(a, b, min(value, quality.get((b, a), value))) for (a, b), value in quality.items()]
    links += [Link(a, b, 1.0, wired=True) for a, b in wires]
    return graph_of((report.node for report in known_reports), links)


def seen_by(
    reports: Iterable[Report], known_macs: Mapping[str, str], *, fresh_ms: int = NEIGHBOR_FRESH_MS
) -> dict[str, tuple[Sighting, ...]]:
    """Node -> the nodes that hear it and how long ago, latest first."""
    known_reports = tuple(reports)
    names = names_by_mac(known_reports, known_macs)
    known = frozenset(names.values())
    sightings: dict[str, list[Sighting]] = {}
    for report in known_reports:
        for name, heard in heard_by_name(report, names, fresh_ms=fresh_ms).items():
            if name in known:
                sightings.setdefault(name, []).append(Sighting(report.node, heard.last_seen_ms, heard.signal_dbm))
    return {
        name: tuple(sorted(found, key=lambda sighting: (sighting.age_ms, sighting.by)))
        for name, found in sightings.items()
    }
