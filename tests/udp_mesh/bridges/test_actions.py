"""Names, destinations and ends of actionlib's actions across the mesh, without ROS."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from udp_mesh.bridges.call_messages import Offer
from udp_mesh.bridges.message_codec import decode, encode
from udp_mesh.bridges.message_definition import MessageDefinition
from udp_mesh.bridges.names import Route
from udp_mesh.bridges.ros1.actions import (
    FEEDBACK,
    RESULT,
    STATUS,
    STATUS_ARRAY,
    STATUS_S,
    Actions,
    goal_id,
    offer_of,
    offered_types,
)
from udp_mesh.bridges.types import TypeKey

TYPES = {
    FEEDBACK: TypeKey("actionlib/TestActionFeedback", "6d3d0bf7fb3dda24779c010a9f3eb7cb"),
    RESULT: TypeKey("actionlib/TestActionResult", "3d669e3a63aa986c667ea7b0f46ce85e"),
}
OFFER = offer_of("/move", TYPES, 30.0)
GOAL = MessageDefinition(
    "pkg/ActionGoal",
    "Header header\nGoalID goal_id\nint32 goal\n"
    + "=" * 80 + "\nMSG: std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id\n"
    + "=" * 80 + "\nMSG: pkg/GoalID\ntime stamp\nstring id\n",
)  # fmt: skip


def goal(name: str) -> bytes:
    header = {"seq": 3, "stamp": (5, 6), "frame_id": "map"}
    return encode(GOAL, {"header": header, "goal_id": {"stamp": (7, 8), "id": name}, "goal": 1}, 1)


def status(seq: int, frame: str, goals: list[str]) -> bytes:
    listed = [{"goal_id": {"id": name}, "status": 1} for name in goals]
    return encode(STATUS_ARRAY, {"header": {"seq": seq, "frame_id": frame}, "status_list": listed}, 1)


def test_the_status_message_is_actionlibs() -> None:
    assert STATUS_ARRAY.md5sum == "8b2b82f13216d0a8ea88bd3af735e619"


def test_an_offer_tells_the_types_that_a_client_needs() -> None:
    assert offered_types(OFFER) == {**TYPES, STATUS: TypeKey(STATUS_ARRAY.name, STATUS_ARRAY.md5sum)}
    assert (OFFER.name, OFFER.lost_s) == ("/move", 30.0)


@given(st.text(max_size=50), st.binary(max_size=60))
def test_any_offer_and_any_goal_are_read_or_left(text: str, data: bytes) -> None:
    offered_types(Offer("/move", "actionlib " + text, "", 0.0))
    goal_id(data)


def test_a_service_is_no_action() -> None:
    assert offered_types(Offer("/add", "made/Add", "0" * 32, 5.0)) is None
    assert Actions("bob", ()).on_offered("alice", Offer("/add", "made/Add", "0" * 32, 5.0)) is None


def test_clients_find_the_action_under_the_peers_name_and_their_goals_go_to_it_alone() -> None:
    actions = Actions("bob", ())
    proxy = actions.on_offered("alice", OFFER)
    assert proxy is not None
    assert proxy.names[STATUS] == "/alice/mesh_comm/bob/move/status"
    assert actions.routes() == {
        "/alice/mesh_comm/bob/move/goal": Route("move/goal", "alice"),
        "/alice/mesh_comm/bob/move/cancel": Route("move/cancel", "alice"),
    }
    assert actions.from_ros(Route("move/goal", "alice"), goal("g"), 0.0) == [Route("move/goal", "alice")]


def test_goals_reach_the_server_and_its_answers_those_that_called() -> None:
    actions = Actions("alice", ["/move"])
    actions.peers = frozenset({"bob", "carol"})
    assert set(actions.routes()) == {"/move/status", "/move/feedback", "/move/result"}
    assert actions.from_ros(Route("move/result", None), b"", 0.0) == []
    assert actions.local_name("/bob/mesh_comm/alice/move/goal") == "/move/goal"
    assert actions.local_name("/bob/mesh_comm/alice/status") == "/bob/mesh_comm/alice/status"
    for part in (FEEDBACK, RESULT):
        assert actions.from_ros(Route(f"move/{part}", None), b"", 0.0) == [Route(f"move/{part}", "bob")]


def test_a_status_is_sent_when_it_changed_and_once_a_second() -> None:
    actions, route = Actions("alice", ["/move"]), Route("move/status", None)
    sent = [
        bool(actions.from_ros(route, message, now))
        for message, now in (
            (status(1, "map", []), 0.0),
            (status(2, "map", []), 0.2),
            (status(3, "map", ["g"]), 0.4),
            (status(4, "other", ["g"]), 0.6),
            (status(5, "map", ["g"]), 0.5 + STATUS_S),
        )
    ]
    assert sent == [True, False, True, False, True]


def test_goals_are_lost_when_the_peer_stays_away_and_not_before() -> None:
    actions = Actions("bob", ())
    proxy = actions.on_offered("alice", OFFER)
    actions.from_ros(Route("move/goal", "alice"), goal("g1"), 0.0)
    actions.from_ros(Route("move/goal", "alice"), b"no goal", 0.0)
    assert actions.on_withdrawn("alice", "/move", 10.0)
    assert not actions.on_withdrawn("alice", "/add", 10.0)
    assert actions.lost(39.0) == []
    # back in time, and away again
    assert actions.on_offered("alice", OFFER) is proxy
    assert actions.lost(100.0) == []
    actions.on_withdrawn("alice", "/move", 100.0)
    assert actions.lost(130.0) == [proxy]
    assert actions.routes() == {}
    assert proxy is not None
    known, gone = (decode(STATUS_ARRAY, payload, 1)["status_list"] for payload in proxy.lost_statuses())
    assert [(each["goal_id"]["id"], each["goal_id"]["stamp"], each["status"]) for each in known] == [("g1", (7, 8), 0)]
    assert gone == []
    assert proxy.lost_statuses() == []
