"""An undirected graph of nodes: distances, cut vertices, and what each one cuts off.

Links (name, name, quality) -> `graph_of` -> `Graph`: `paths` (hops and quality to the entry), `farthest_first`,
`cut_off_by` (cut vertices: Hopcroft and Tarjan's articulation points, CACM 16(6), 1973), `cut_off_by_all` (what
a whole set of nodes going down at once would cut off). Everything is linear in links, except the last per call.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType


@dataclass(frozen=True, slots=True)
class Link:
    """Two nodes that hear each other. `quality` 0..1 is the worse of the two directions (batman-adv's TQ / 255); a wire
    has quality 1 and does not depend on radios."""

    a: str
    b: str
    quality: float = 1.0
    wired: bool = False


@dataclass(frozen=True, slots=True)
class Path:
    """The best path from a node to the entry: its hops, the product of its links' qualities, the next node."""

    hops: int
    quality: float
    via: str


@dataclass(frozen=True, slots=True)
class Graph:
    """`neighbors[name]` maps each neighbor to the best link to it. Names are sorted, so results are deterministic."""

    neighbors: Mapping[str, Mapping[str, Link]] = field(default_factory=lambda: MappingProxyType({}))

    @property
    def nodes(self) -> tuple[str, ...]:
        return tuple(self.neighbors)

    @property
    def links(self) -> tuple[Link, ...]:
        return tuple(link for name, around in self.neighbors.items() for other, link in around.items() if name < other)

    def __contains__(self, name: object) -> bool:
        return name in self.neighbors

    def reachable(self, entry: str, without: Iterable[str] = ()) -> frozenset[str]:
        """Every node with a path to `entry` that avoids `without`; empty if the entry is not in the graph."""
        gone = set(without)
        if entry not in self.neighbors or entry in gone:
            return frozenset()
        seen, waiting = {entry}, [entry]
        while waiting:
            fresh = [other for other in self.neighbors[waiting.pop()] if other not in seen and other not in gone]
            seen.update(fresh)
            waiting.extend(fresh)
        return frozenset(seen)

    def paths(self, entry: str) -> dict[str, Path]:
        """The best path of every reachable node to `entry`: highest quality first, then fewest hops (Dijkstra)."""
        if entry not in self.neighbors:
            return {}
        found: dict[str, Path] = {}
        waiting: list[tuple[float, int, str, str]] = [(-1.0, 0, entry, entry)]
        while waiting:
            negative, hops, name, via = heapq.heappop(waiting)
            if name in found:
                continue
            found[name] = Path(hops, -negative, via)
            for other, link in self.neighbors[name].items():
                if other not in found:
                    heapq.heappush(waiting, (negative * link.quality, hops + 1, other, name))
        return found

    def paths_to_any(self, entries: Iterable[str]) -> dict[str, Path]:
        """The best path of every node to the first of these entries that it can reach."""
        found: dict[str, Path] = {}
        for entry in entries:
            if entry not in found:
                found |= self.paths(entry)
        return found

    def farthest_first(self, *entries: str) -> tuple[str, ...]:
        """Nodes by hops to their entry, most first; of equals the weaker path first; unreachable ones first of all."""
        paths = self.paths_to_any(entries)
        unreachable = len(self.neighbors)

        def distance(name: str) -> tuple[int, float, str]:
            path = paths.get(name)
            return (-path.hops, path.quality, name) if path else (-unreachable, 0.0, name)

        return tuple(sorted(self.neighbors, key=distance))

    def cut_off_by(self, entry: str) -> dict[str, tuple[str, ...]]:
        """For each cut vertex in the entry's component (the entry excepted): the nodes that lose `entry` without it."""
        if entry not in self.neighbors:
            return {}
        order: dict[str, int] = {entry: 0}
        low: dict[str, int] = {entry: 0}
        visited = [entry]
        cut: dict[str, list[str]] = {}
        stack: list[tuple[str, str, Iterator[str]]] = [(entry, "", iter(self.neighbors[entry]))]
        while stack:
            name, parent, others = stack[-1]
            for other in others:
                if other not in order:
                    order[other] = low[other] = len(visited)
                    visited.append(other)
                    stack.append((other, name, iter(self.neighbors[other])))
                    break
                if other != parent:
                    low[name] = min(low[name], order[other])
            else:
                stack.pop()
                if not stack:
                    break
                low[parent] = min(low[parent], low[name])
                if parent != entry and low[name] >= order[parent]:
                    # the nodes visited since `name` are its subtree, connected to the entry only through `parent`
                    cut.setdefault(parent, []).extend(visited[order[name] :])
        return {name: tuple(sorted(lost)) for name, lost in sorted(cut.items())}

    def cut_off_by_any(self, entries: Iterable[str]) -> dict[str, tuple[str, ...]]:
        """As `cut_off_by`, for each component with one of these entries and the first one there."""
        found: dict[str, tuple[str, ...]] = {}
        seen: set[str] = set()
        for entry in entries:
            if entry not in seen:
                seen |= self.reachable(entry)
                found |= self.cut_off_by(entry)
        return dict(sorted(found.items()))

    def cut_off_by_all(self, entries: Iterable[str], down: Iterable[str]) -> frozenset[str]:
        """The nodes outside `down` that reach an entry now and would reach none if all of `down` were gone at once."""
        gone = frozenset(down)
        found: set[str] = set()
        left: set[str] = set()
        for entry in entries:
            found |= self.reachable(entry)
            left |= self.reachable(entry, gone)
        return frozenset(found - left - gone)


EMPTY = Graph()


def graph_of(nodes: Iterable[str], links: Iterable[Link]) -> Graph:
    """The graph of these nodes and links; of several links between two nodes the best counts, loops are dropped.

    Raises ValueError for a quality outside 0..1.
    """
    around: dict[str, dict[str, Link]] = {name: {} for name in nodes}
    for link in links:
        if not 0.0 <= link.quality <= 1.0:
            raise ValueError(f"link {link.a}-{link.b}: quality {link.quality} is not within 0..1")
        if link.a == link.b:
            continue
        known = around.setdefault(link.a, {}).get(link.b)
        if known is None or (link.wired, link.quality) > (known.wired, known.quality):
            around[link.a][link.b] = around.setdefault(link.b, {})[link.a] = link
    return Graph(
        MappingProxyType({name: MappingProxyType(dict(sorted(around[name].items()))) for name in sorted(around)})
    )
