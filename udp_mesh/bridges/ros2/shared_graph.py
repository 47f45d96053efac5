"""Robots whose bridges are in one ROS graph, and what each bridge leaves to ROS because of them. Pure.

A bridge publishes what it receives from `alice` as `/alice/mesh_comm/<self>/...`, the names that alice's bridge reads
to send to this robot. In one graph a message would go in circles. So a bridge does not read the names of robots whose
bridges are in its graph: ROS itself takes those messages to them. No other bridge publishes under the names that it
reads, so everything else is sent over the mesh: to robots outside of the graph, and what is for all to these, too.

Transforms have one name for all, so the first of the robots by name sends and merges those of the whole graph.
"""

from __future__ import annotations

from typing import AbstractSet, Iterable, NamedTuple, Tuple

from udp_mesh.bridges.names import PREFIX, ros_word
from udp_mesh.bridges.ros2.quality import ros2_name


class SharedGraph(NamedTuple):
    """The other robots in the graph of robot `own`, as segments of ROS names. `strangers` are namespaces of bridges
    that belong to no peer, such as one in a remapped namespace: what they publish is not known."""

    own: str
    robots: AbstractSet[str] = frozenset()
    strangers: AbstractSet[str] = frozenset()

    @property
    def is_shared(self) -> bool:
        return bool(self.robots or self.strangers)

    def may_read(self, name: str) -> bool:
        """Whether no other bridge publishes under this name of our own."""
        start = "/{}/{}/".format(self.own, PREFIX)
        return not self.strangers and not any(name.startswith(start + robot + "/") for robot in self.robots)

    @property
    def sends_transforms(self) -> bool:
        return not self.strangers and all(self.own < robot for robot in self.robots)

    def merges_transforms_from(self, robot: str) -> bool:
        return self.sends_transforms and robot not in self.robots

    def __str__(self) -> str:
        spaces = ",".join(sorted([*("/" + robot for robot in self.robots), *self.strangers]))
        left = "nothing is sent over the mesh, because the daemon knows no robot " + ",".join(sorted(self.strangers))
        if not self.strangers:
            left = "what is published for one of them alone is not sent over the mesh"
        return "bridges-in-one-graph others={}: ROS 2 itself connects these robots: {}".format(spaces, left)


def shared_graph(own: str, spaces: Iterable[str], peers: Iterable[str]) -> SharedGraph:
    """`spaces`: the namespaces of the other bridges in the graph; `own` and `peers` are mesh names."""
    known = {"/" + _segment(peer) for peer in peers}
    found = frozenset(spaces)
    return SharedGraph(_segment(own), frozenset(space[1:] for space in found & known), found - known)


def other_bridges(nodes: Iterable[Tuple[str, str]], node: str, namespace: str) -> AbstractSet[str]:
    """The namespaces of nodes with this name outside of `namespace`, of all nodes (name, namespace) of the graph."""
    return {space for name, space in nodes if name == node and space != namespace}


class DoubleBridge:
    """Finds a second bridge of this robot: every message would be sent and published twice.

    A bridge that was killed stays in the graph for the 20 s of DDS's lease, so that one counts only after
    `PATIENCE` looks, one a second.
    """

    PATIENCE = 30

    def __init__(self, node: str, namespace: str) -> None:
        self._own = (node, namespace)
        self._looks = 0

    def is_new(self, nodes: Iterable[Tuple[str, str]]) -> bool:
        """Whether this look at all nodes (name, namespace) of the graph is the first that confirms it."""
        self._looks = self._looks + 1 if sum(each == self._own for each in nodes) > 1 else 0
        return self._looks == self.PATIENCE


def _segment(name: str) -> str:
    return ros2_name(ros_word(name))
