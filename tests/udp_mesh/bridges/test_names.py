"""Names of the legacy system."""

from __future__ import annotations

import re

from hypothesis import given
from hypothesis import strategies as st

from udp_mesh.bridges.names import (
    Route,
    inbound_name,
    outbound_name,
    parse_topic_list,
    ros_path,
    routes,
    undeclared_route,
)

NAMES = st.text(st.characters(exclude_characters="/", exclude_categories=("Z", "C")), min_size=1, max_size=12)
TOPICS = st.lists(NAMES, min_size=1, max_size=3).map("/".join)


def test_topic_names_match_the_legacy_system() -> None:
    assert outbound_name("ugv1", Route("map", "base")) == "/ugv1/mesh_comm/base/map"
    assert outbound_name("ugv1", Route("map", None)) == "/ugv1/mesh_comm/map"
    assert inbound_name("ugv1", "base", "map") == "/base/mesh_comm/ugv1/map"


@given(NAMES, NAMES, TOPICS)
def test_every_generated_name_is_a_valid_ros_name(own: str, peer: str, topic: str) -> None:
    for name in (inbound_name(own, peer, topic), outbound_name(own, Route(topic, peer))):
        assert re.fullmatch(r"(/[A-Za-z_][A-Za-z0-9_]*)+", name)


@given(NAMES, st.lists(NAMES), st.lists(TOPICS), TOPICS)
def test_inbound_names_never_match_outbound_routes(own: str, peers: list[str], topics: list[str], topic: str) -> None:
    table = routes(own, topics, peers)
    for peer in peers:
        start = outbound_name(own, Route("x", None)).rpartition("/")[0]
        if inbound_name(own, peer, topic).startswith(start + "/"):
            assert all(route.peer != peer for route in table.values())


@given(NAMES, st.lists(TOPICS, unique_by=ros_path), NAMES)
def test_every_topic_has_an_outbound_name_per_peer(own: str, topics: list[str], peer: str) -> None:
    table = routes(own, topics, [peer])
    if inbound_name(own, own, "x") != inbound_name(own, peer, "x"):
        for topic in topics:
            assert table[outbound_name(own, Route(topic, peer))] == Route(topic, peer)


def test_an_undeclared_topic_name_routes_to_the_named_peer_or_to_all() -> None:
    assert undeclared_route("a", "/a/mesh_comm/bob/map/diff", ["bob"]) == Route("map/diff", "bob")
    assert undeclared_route("a", "/a/mesh_comm/map/diff", ["bob"]) == Route("map/diff", None)
    assert undeclared_route("a", "/b/mesh_comm/a/map", ["bob"]) is None
    assert undeclared_route("a", "/a/mesh_comm/", ["bob"]) is None


def test_the_legacy_topic_list_is_parsed_and_every_error_reported() -> None:
    listed, problems = parse_topic_list(["1|std_msgs/String|high", "99|a/B|/low/", "x|a/B|c", "no bars", 7])
    assert [tuple(topic) for topic in listed] == [("high", 1), ("low", 15)]
    assert [problem.partition(":")[0] for problem in problems] == ["topic_list[2]", "topic_list[3]", "topic_list[4]"]
