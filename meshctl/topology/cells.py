"""Separate the meshes of a node with several: observations reduced to one mesh, and the cells of each link.

A node's batman-adv spans its meshes, so its tables have the neighbors of all of them, with the interface of each.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

from meshctl.device.observation import Observation
from meshctl.model import Band, Fleet, Node
from meshctl.topology.observed import Report, heard_by_name
from meshctl.topology.reports import report_of


@dataclass(frozen=True, slots=True)
class LinkCell:
    """The cell of a link: its mesh, and the radio's channel (that of the inventory if unknown)."""

    mesh: str
    band: Band
    channel: int

    def __str__(self) -> str:
        return f"{self.mesh} {self.band.value} ch {self.channel}"


def within(observation: Observation, node: Node, mesh: str) -> Observation:
    """The observation reduced to one mesh of the node; unchanged for a node with one mesh."""
    if len(node.meshes) < 2:
        return observation
    names = {name for name, joined in node.mesh_interfaces.items() if joined == mesh}
    all_hard = None if observation.mesh is None else observation.mesh.hard_interfaces
    hard = None if all_hard is None else tuple(name for name in all_hard if name in names)
    return replace(
        observation,
        macs={name: mac for name, mac in (observation.macs or {}).items() if name in names},
        links=tuple(link for link in observation.links or () if link.ifname in names),
        stations=tuple(station for station in observation.stations or () if station.ifname in names),
        neighbors=None
        if observation.neighbors is None
        else tuple(n for n in observation.neighbors if n.ifname in names),
        originators=None
        if observation.originators is None
        else tuple(o for o in observation.originators if o.ifname in names),
        mesh=None if observation.mesh is None else replace(observation.mesh, hard_interfaces=hard),
    )


def mesh_reports(fleet: Fleet, observations: Mapping[str, Observation], mesh: str) -> dict[str, Report]:
    """The reports of a mesh's members, reduced to this mesh."""
    return {
        name: report_of(name, within(observation, fleet.nodes[name], mesh))
        for name, observation in observations.items()
        if name in fleet.nodes and mesh in fleet.nodes[name].meshes
    }


def link_cells(
    fleet: Fleet, observations: Mapping[str, Observation], names: Mapping[str, str], meshes: Iterable[str]
) -> dict[tuple[str, str], tuple[LinkCell, ...]]:
    """The cells in which `a` hears `b`, in the order of `meshes`; `names` maps lower-case MACs to nodes."""
    found: dict[tuple[str, str], tuple[LinkCell, ...]] = {}
    for mesh in meshes:
        for name, report in mesh_reports(fleet, observations, mesh).items():
            for other in heard_by_name(report, names):
                cell = LinkCell(
                    mesh, fleet.meshes[mesh].band, _channel(fleet, fleet.nodes[name], observations[name], mesh)
                )
                found[name, other] = (*found.get((name, other), ()), cell)
    return found


def _channel(fleet: Fleet, node: Node, observation: Observation, mesh: str) -> int:
    observed = (link.channel for link in within(observation, node, mesh).links or () if link.channel is not None)
    return next(observed, fleet.meshes[mesh].channel)
