"""Group the meshes of a fleet that do not depend on each other and can change at the same time. Pure.

Meshes depend on each other if a node other than an entry is in both, if nodes of both hear or are wired to each other,
or if a node of one is the jump host to nodes of the other.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from meshctl.model import Fleet
from meshctl.topology import Graph


def independent_meshes(fleet: Fleet, graph: Graph, entries: Iterable[str]) -> dict[str, frozenset[str]]:
    """Node -> the groups of dependent meshes that it is in, each named after one of them: one group, of entries maybe
    several."""
    ends = frozenset(entries)
    groups = _Groups()
    for node in fleet.nodes.values():
        if node.name not in ends:
            groups.join(node.meshes)
        if node.ssh.jump in fleet.nodes:
            groups.join((*node.meshes, *fleet.nodes[node.ssh.jump].meshes))
    for link in graph.links:
        if not ends & {link.a, link.b} and link.a in fleet.nodes and link.b in fleet.nodes:
            groups.join((*fleet.nodes[link.a].meshes, *fleet.nodes[link.b].meshes))
    return {node.name: frozenset(groups.of(mesh) for mesh in node.meshes) for node in fleet.nodes.values()}


class _Groups:
    """Disjoint sets of names."""

    def __init__(self) -> None:
        self._above: dict[str, str] = {}

    def of(self, name: str) -> str:
        while (above := self._above.get(name, name)) != name:
            name = above
        return name

    def join(self, names: Iterable[str]) -> None:
        first, *others = map(self.of, names) if names else ("",)
        for other in others:
            if other != first:
                self._above[self.of(other)] = self.of(first)


def by_group(names: Iterable[str], groups: Mapping[str, frozenset[str]]) -> list[list[str]]:
    """These nodes by the group they are in, each in the order given; those of no known group are one."""
    found: dict[str, list[str]] = {}
    for name in names:
        found.setdefault(min(groups.get(name) or ("",)), []).append(name)
    return list(found.values())
