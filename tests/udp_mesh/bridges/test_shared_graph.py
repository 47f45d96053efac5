"""What bridges in one ROS graph leave to ROS: everything arrives once, and nothing goes in circles."""

from __future__ import annotations

from itertools import combinations

import pytest

from udp_mesh.bridges.names import Route, inbound_name, outbound_name, routes
from udp_mesh.bridges.ros2.quality import ros2_name
from udp_mesh.bridges.ros2.shared_graph import SharedGraph, other_bridges, shared_graph

ROBOTS = ("ugv-1", "bob", "carol", "dora")
TOPICS = ("status", "bob/map")


def of(own: str, group: tuple[str, ...]) -> SharedGraph:
    """The graph of a robot as its bridge finds it, if the bridges of this group see each other."""
    spaces = ["/" + ros2_name(name.replace("-", "_")) for name in group if name != own] if own in group else []
    return shared_graph(own, spaces, [name for name in ROBOTS if name != own])


def read_by(own: str, group: tuple[str, ...]) -> dict[str, Route]:
    peers = [name for name in ROBOTS if name != own]
    graph = of(own, group)
    return {name: route for name, route in routes(own, TOPICS, peers).items() if graph.may_read(name)}


@pytest.mark.parametrize("group", [group for size in (0, 2, 3, 4) for group in combinations(ROBOTS, size)])
def test_no_bridge_reads_what_another_bridge_of_its_graph_publishes(group: tuple[str, ...]) -> None:
    published = {inbound_name(own, source, topic) for own in group for source in ROBOTS for topic in TOPICS}
    for own in group:
        assert not published & set(read_by(own, group))


@pytest.mark.parametrize("group", [group for size in (0, 2, 3, 4) for group in combinations(ROBOTS, size)])
def test_only_what_ros_brings_itself_is_not_sent_over_the_mesh(group: tuple[str, ...]) -> None:
    for own in ROBOTS:
        read = read_by(own, group)
        for peer in ROBOTS:
            is_joined = own in group and peer in group
            if peer != own:
                assert (outbound_name(own, Route("status", peer)) in read) == (not is_joined)
        assert read[outbound_name(own, Route("status", None))] == Route("status", None)


@pytest.mark.parametrize("group", [group for size in (2, 3, 4) for group in combinations(ROBOTS, size)])
def test_one_robot_of_a_graph_sends_and_merges_its_transforms(group: tuple[str, ...]) -> None:
    graphs = {own: of(own, group) for own in ROBOTS}
    senders = [own for own in group if graphs[own].sends_transforms]
    assert len(senders) == 1
    for own in ROBOTS:
        merged = {peer for peer in ROBOTS if peer != own and graphs[own].merges_transforms_from(peer.replace("-", "_"))}
        outside = set(ROBOTS) - set(group)
        assert merged == (
            set()
            if own in group and own not in senders
            else outside - {own} | (set(group) if own in outside else set())
        )


def test_a_bridge_of_no_peer_stops_everything() -> None:
    graph = shared_graph("bob", ["/carol", "/remapped"], ["carol"])
    assert not graph.may_read("/bob/mesh_comm/status")
    assert not graph.sends_transforms
    assert "others=/carol,/remapped" in str(graph)
    assert "nothing is sent over the mesh" in str(graph)
    assert "/remapped" in str(graph).partition("nothing is sent")[2]


def test_a_graph_of_ones_own_carries_everything() -> None:
    graph = shared_graph("bob", [], ["carol"])
    assert not graph.is_shared
    assert graph.may_read("/bob/mesh_comm/carol/status")
    assert graph.merges_transforms_from("carol")


def test_other_bridges_are_nodes_of_that_name_elsewhere() -> None:
    nodes = [("mesh_bridge", "/bob"), ("mesh_bridge", "/carol"), ("camera", "/carol"), ("mesh_bridge", "/carol")]
    assert other_bridges(nodes, "mesh_bridge", "/bob") == {"/carol"}
