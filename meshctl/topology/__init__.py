"""The mesh as a graph: links, distances to the entry, and what the loss of each node cuts off."""

from meshctl.topology.alternate_macs import alternate_macs, with_alternates
from meshctl.topology.graph import EMPTY, Graph, Link, Path, graph_of
from meshctl.topology.observed import (
    NEIGHBOR_FRESH_MS,
    HeardNeighbor,
    Report,
    Sighting,
    heard_by_name,
    names_by_mac,
    observed_graph,
    seen_by,
)
from meshctl.topology.reports import mesh_macs, report_of

__all__ = [
    "EMPTY",
    "NEIGHBOR_FRESH_MS",
    "Graph",
    "HeardNeighbor",
    "Link",
    "Path",
    "Report",
    "Sighting",
    "alternate_macs",
    "graph_of",
    "heard_by_name",
    "mesh_macs",
    "names_by_mac",
    "observed_graph",
    "report_of",
    "seen_by",
    "with_alternates",
]
