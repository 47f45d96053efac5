"""The mesh as a graph: who hears whom, how far each node is from where we stand, what each node's loss cuts off."""

from meshctl.topology.graph import EMPTY, Graph, Link, Path, graph_of
from meshctl.topology.observed import Heard, Report, Sighting, observed_graph, seen_by

__all__ = [
    "EMPTY",
    "Graph",
    "Heard",
    "Link",
    "Path",
    "Report",
    "Sighting",
    "graph_of",
    "observed_graph",
    "seen_by",
]
