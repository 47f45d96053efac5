"""From what nodes tell about their neighbours to one graph of the mesh.

Each node that answered gives a `Report` (its own mesh MACs, whom it hears); `observed_graph` turns MACs into names and
both directions of a link into one; `seen_by` tells who still hears a node that does not answer.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from meshctl.topology.graph import Graph, Link, graph_of

# A neighbour that has been silent for longer is not a link: batman-adv keeps dead ones in its tables for minutes.
NEIGHBOUR_FRESH_MS = 10_000


@dataclass(frozen=True, slots=True)
class Heard:
    """A neighbour in a node's table: `quality` 0..1, None when only its presence is known."""

    mac: str
    last_seen_ms: int
    quality: float | None = None
    signal_dbm: int | None = None


@dataclass(frozen=True, slots=True)
class Report:
    """What one node knows: the MACs of its mesh interfaces, the neighbours it hears (lower-case MACs)."""

    node: str
    macs: tuple[str, ...]
    heard: tuple[Heard, ...] = ()


@dataclass(frozen=True, slots=True)
class Sighting:
    """Somebody heard a node: `by` whom, `age_ms` ago at the time of that node's report."""

    by: str
    age_ms: int
    signal_dbm: int | None = None


def names_by_mac(reports: Iterable[Report], known_macs: Mapping[str, str]) -> dict[str, str]:
    """MAC -> node name; what a node says of itself wins over `known_macs` (inventory, last known state)."""
    names = {mac.lower(): name for mac, name in known_macs.items()}
    names.update({mac.lower(): report.node for report in reports for mac in report.macs})
    return names


def observed_graph(
    reports: Iterable[Report],
    *,
    known_macs: Mapping[str, str] | None = None,
    wires: Iterable[tuple[str, str]] = (),
    fresh_ms: int = NEIGHBOUR_FRESH_MS,
) -> Graph:
    """The mesh as its nodes report it. `wires` are pairs joined by cable (two radios on a robot's switch).

    A link has the worse quality of its two directions; one reported by a single side (the other did not answer) has
    that side's. MACs nobody owns become nodes under their MAC, so that a stranger in the mesh shows.
    """
    told = tuple(reports)
    names = names_by_mac(told, known_macs or {})
    quality: dict[tuple[str, str], float] = {}
    for report in told:
        for heard in report.heard:
            other = names.get(heard.mac.lower(), heard.mac.lower())
            if heard.last_seen_ms > fresh_ms or other == report.node:
                continue
            value = 1.0 if heard.quality is None else heard.quality
            # of a node's several radios, the best one to this neighbour carries the traffic
            quality[report.node, other] = max(value, quality.get((report.node, other), 0.0))
    links = [Link(a, b, min(value, quality.get((b, a), value))) for (a, b), value in quality.items()]
    links += [Link(a, b, 1.0, wired=True) for a, b in wires]
    return graph_of((report.node for report in told), links)


def seen_by(
    reports: Iterable[Report], known_macs: Mapping[str, str], *, fresh_ms: int = NEIGHBOUR_FRESH_MS
) -> dict[str, tuple[Sighting, ...]]:
    """For every node that somebody hears: by whom and how long ago, the latest first."""
    told = tuple(reports)
    names = names_by_mac(told, known_macs)
    sightings: dict[str, list[Sighting]] = {}
    for report in told:
        for heard in report.heard:
            name = names.get(heard.mac.lower())
            if name is not None and name != report.node and heard.last_seen_ms <= fresh_ms:
                sightings.setdefault(name, []).append(Sighting(report.node, heard.last_seen_ms, heard.signal_dbm))
    return {name: tuple(sorted(seen, key=lambda s: (s.age_ms, s.by))) for name, seen in sightings.items()}
