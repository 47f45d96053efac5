"""The relay's decisions: two relays connected in memory, without ROS and daemon."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from udp_mesh.bridges.names import Route
from udp_mesh.bridges.protocol import Definition, Hello, ProtocolError, Want, decode, encode
from udp_mesh.bridges.relay import (
    DEFINITION_TIMEOUT_S,
    MAX_LATCHED_PER_ROUTE,
    MAX_WAITING_MESSAGES,
    REQUEST_RETRY_S,
    Effect,
    Note,
    Relay,
    ToMesh,
    ToRos,
)
from udp_mesh.bridges.ros2.quality import Quality, quality_text
from udp_mesh.bridges.types import (
    MAX_DEFINITION_BYTES,
    Definitions,
    LatchMark,
    MeshTopic,
    MessageKind,
    TypeKey,
    kind_text,
    parse_kind,
)

EXCHANGE = "bridge/ros1"
STRING = TypeKey("std_msgs/String", "992ce8a1687cec8c8bd883ec73ca41d1")
WORDS = st.text(st.characters(codec="ascii", exclude_characters="/ ", exclude_categories=("Z", "C")), min_size=1)


def relay(own: str) -> Relay:
    return Relay(own, EXCHANGE, ros_version=1, nonce=own.encode())


def carry(effects: list[Effect], source: str, target: Relay, now: float = 0.0) -> list[Effect]:
    """The target's effects for what the source sent over the mesh."""
    found: list[Effect] = []
    for effect in effects:
        if isinstance(effect, ToMesh) and effect.peer in (None, target.own):
            found += target.from_mesh(source, effect.topic, effect.type, effect.payload, now)
    return found


def to_bob(alice: Relay, text: bytes, *, latched: bool = False, publisher: str = "/node") -> list[Effect]:
    return alice.from_ros(Route("status", "bob"), publisher, STRING, "string data", latched, text)


def test_the_definition_goes_first_and_only_once() -> None:
    alice, bob = relay("alice"), relay("bob")
    first, second = to_bob(alice, b"1"), to_bob(alice, b"2")
    assert len(first) == 2
    assert len(second) == 1
    name = "/alice/mesh_comm/bob/status"
    assert carry(first, "alice", bob) == [ToRos(name, STRING, "string data", False, b"1")]
    assert carry(second, "alice", bob) == [ToRos(name, STRING, "string data", False, b"2")]


def test_messages_wait_in_order_while_a_lost_definition_is_requested() -> None:
    alice, bob = relay("alice"), relay("bob")
    asked = carry(to_bob(alice, b"1")[1:], "alice", bob, now=0.0)
    assert carry(to_bob(alice, b"2"), "alice", bob, now=0.1) == []
    assert bob.tick(REQUEST_RETRY_S / 2) == []
    assert bob.tick(REQUEST_RETRY_S) == asked
    answered = carry(asked, "bob", alice)
    published = carry(answered, "alice", bob)
    assert [effect.payload for effect in published if isinstance(effect, ToRos)] == [b"1", b"2"]
    assert bob.tick(10.0) == []


def test_the_waiting_queue_is_bounded_and_dropped_messages_are_counted() -> None:
    alice, bob = relay("alice"), relay("bob")
    for number in range(MAX_WAITING_MESSAGES + 5):
        carry(to_bob(alice, bytes([number]))[-1:], "alice", bob)
    assert bob.dropped == 5


def test_a_late_robot_receives_only_the_latched_messages_it_lacks() -> None:
    alice, bob = relay("alice"), relay("bob")
    to_bob(alice, b"old", latched=True)
    to_bob(alice, b"new", latched=True)
    to_bob(alice, b"other", latched=True, publisher="/other")
    missing = carry(bob.on_peer_online("alice"), "bob", alice)
    assert sorted(effect.payload for effect in missing if isinstance(effect, ToMesh) and effect.topic == "status") == [
        b"new",
        b"other",
    ]
    waiting = carry(missing, "alice", bob)
    carry(carry(waiting, "bob", alice), "alice", bob)
    again = carry(bob.on_peer_online("alice"), "bob", alice)
    assert [effect for effect in again if isinstance(effect, ToMesh) and effect.topic == "status"] == []


def test_a_latched_message_that_is_repeated_is_published_once() -> None:
    alice, bob = relay("alice"), relay("bob")
    greeting = bob.on_peer_online("alice")
    assert len(carry(to_bob(alice, b"map", latched=True), "alice", bob)) == 1
    repeated = [effect for effect in carry(greeting, "bob", alice) if isinstance(effect, ToMesh)]
    assert any(effect.payload == b"map" for effect in repeated)
    assert [effect for effect in carry(list(repeated), "alice", bob) if isinstance(effect, ToRos)] == []


def test_the_newest_latched_message_is_kept_when_messages_arrive_out_of_order() -> None:
    alice, bob = relay("alice"), relay("bob")
    carry(to_bob(alice, b"0"), "alice", bob)
    stop, go = to_bob(alice, b"stop", latched=True), to_bob(alice, b"go", latched=True)
    assert len(carry(go, "alice", bob)) == 1
    assert carry(stop, "alice", bob) == []
    # Another publisher's message is not an earlier one, nor is one of the same publisher after its bridge restarted.
    assert len(carry(to_bob(alice, b"x", latched=True, publisher="/other"), "alice", bob)) == 1
    again = Relay("alice", EXCHANGE, ros_version=1, nonce=b"another start")
    assert len(carry(to_bob(again, b"stop", latched=True)[-1:], "alice", bob)) == 1


def test_latched_messages_of_former_publishers_are_evicted_before_newer_ones() -> None:
    alice, bob = relay("alice"), relay("bob")
    for number in range(3 * MAX_LATCHED_PER_ROUTE):
        carry(to_bob(alice, b"%d" % number, latched=True, publisher=f"/rostopic_{number}"), "alice", bob)
    # Bob has all of it; nothing old is repeated over the last one.
    repeated = carry(bob.on_peer_online("alice"), "bob", alice)
    assert [effect for effect in repeated if isinstance(effect, ToMesh) and effect.topic == "status"] == []
    late = carry(relay("bob").on_peer_online("alice"), "bob", alice)
    sent = [effect.payload for effect in late if isinstance(effect, ToMesh) and effect.topic == "status"]
    assert len(sent) == MAX_LATCHED_PER_ROUTE
    assert sent[-1] == b"%d" % (3 * MAX_LATCHED_PER_ROUTE - 1)


def test_a_missing_definition_blocks_its_topic_only_until_a_timeout() -> None:
    alice, bob = relay("alice"), relay("bob")
    carry(to_bob(alice, b"known"), "alice", bob)
    assert bob.from_mesh("alice", "status", "made/Up 0123", b"x", 0.0) != []
    assert carry(to_bob(alice, b"waits"), "alice", bob, now=1.0) == []
    freed = bob.tick(DEFINITION_TIMEOUT_S + 0.5)
    assert [effect.payload for effect in freed if isinstance(effect, ToRos)] == [b"waits"]
    assert [type(effect) for effect in freed if not isinstance(effect, (ToRos, ToMesh))] == [Note]
    assert bob.dropped == 1


def test_a_publisher_without_a_type_is_reported_once_and_not_relayed() -> None:
    alice = relay("alice")
    found = [alice.from_ros(Route("any", None), "/node", TypeKey("*", "*"), "", False, b"x") for _ in range(3)]
    assert [[type(effect) for effect in effects] for effects in found] == [[Note], [], []]


def test_a_publisher_without_a_definition_does_not_overwrite_a_known_definition() -> None:
    alice = relay("alice")
    to_bob(alice, b"1")
    alice.from_ros(Route("status", "bob"), "/rosserial", STRING, "", False, b"2")
    sent = alice.from_mesh("bob", EXCHANGE, "bridge", encode(Want([STRING])), 0.0)
    assert [decode(effect.payload) for effect in sent if isinstance(effect, ToMesh)] == [
        Definition(STRING, "string data")
    ]


def test_latched_messages_are_sent_only_to_their_destinations() -> None:
    alice = relay("alice")
    alice.set_topics({"map": MeshTopic(("base",))})
    to_bob(alice, b"for bob", latched=True)
    alice.from_ros(Route("map", None), "/node", STRING, "", True, b"for base")
    hello = encode(Hello({}, False))
    sent = {peer: alice.from_mesh(peer, EXCHANGE, "bridge", hello, 0.0) for peer in ("bob", "base", "carol")}
    payloads = {peer: [e.payload for e in effects if isinstance(e, ToMesh)] for peer, effects in sent.items()}
    assert payloads == {"bob": [b"for bob"], "base": [b"for base"], "carol": []}


def test_a_legacy_robot_sends_only_the_type_name() -> None:
    found = relay("bob").from_mesh("old", "status", "std_msgs/String", b"x", 0.0)
    assert found == [ToRos("/old/mesh_comm/bob/status", TypeKey("std_msgs/String", ""), None, False, b"x")]


def test_messages_of_other_bridges_are_left_alone() -> None:
    for type_text in (
        "",
        "zenoh",
        "a/B c d",
        "a/B c latched",
        "a/B c latched:ab:1 e",
    ):
        assert relay("bob").from_mesh("alice", "status", type_text, b"x", 0.0) == []


def test_a_robot_whose_ros_name_equals_ours_is_reported_and_not_published() -> None:
    found = relay("ugv-1").from_mesh("ugv_1", "status", "std_msgs/String", b"x", 0.0)
    assert [type(effect) for effect in found] == [Note]


def test_ros_2_messages_need_no_definition() -> None:
    key = TypeKey("std_msgs/msg/String", quality_text(Quality()))
    alice = Relay("alice", "bridge/ros2", ros_version=2, nonce=b"a")
    bob = Relay("bob", "bridge/ros2", ros_version=2, nonce=b"b")
    published = carry(alice.from_ros(Route("status", None), "", key, "", False, b"cdr"), "alice", bob)
    assert published == [ToRos("/alice/mesh_comm/bob/status", key, None, False, b"cdr")]


@given(st.binary(max_size=200))
def test_any_bytes_on_the_bridge_topic_decode_or_are_reported(data: bytes) -> None:
    try:
        decode(data)
    except ProtocolError:
        assert [type(effect) for effect in relay("bob").from_mesh("a", EXCHANGE, "", data, 0.0)] == [Note]


@given(
    WORDS,
    WORDS,
    st.none() | st.builds(LatchMark, st.from_regex("[0-9a-f]{8}", fullmatch=True), st.integers(0, 1 << 50)),
)
def test_a_type_field_round_trips_through_its_text(name: str, checksum: str, mark: LatchMark | None) -> None:
    kind = MessageKind(TypeKey("pkg/" + name, checksum), mark)
    assert parse_kind(kind_text(kind)) == kind


def test_bridge_messages_round_trip_through_encode_and_decode() -> None:
    for message in (Hello({"t": {"ab": 7}}, True), Want([STRING]), Definition(STRING, "string data")):
        assert decode(encode(message)) == message


def test_definitions_are_bounded() -> None:
    definitions = Definitions()
    assert not definitions.put(STRING, "x" * (MAX_DEFINITION_BYTES + 1))
    for number in range(100):
        assert definitions.put(TypeKey("a/B", str(number)), "x" * MAX_DEFINITION_BYTES)
    kept = [number for number in range(100) if TypeKey("a/B", str(number)) in definitions]
    assert kept == list(range(36, 100))


LOGS = {"artifact": MeshTopic(is_log=True)}


def with_log(own: str) -> Relay:
    made = relay(own)
    made.set_topics(LOGS)
    return made


def to_log(spot: Relay, text: bytes, *, peer: str | None = None, latched: bool = False) -> list[Effect]:
    return spot.from_ros(Route("artifact", peer), "/node", STRING, "string data", latched, text)


def test_the_definition_of_an_item_is_in_the_log_before_it() -> None:
    """The base never meets Spot: its daemon passes what Husky carried, as Spot's."""
    spot, base = with_log("spot"), with_log("base")
    items = [*to_log(spot, b"1"), *to_log(spot, b"2")]
    assert [(one.topic, one.peer) for one in items if isinstance(one, ToMesh)] == [("artifact", None)] * 3
    name = "/spot/mesh_comm/base/artifact"
    assert carry(items, "spot", base) == [ToRos(name, STRING, "string data", False, b"%d" % n) for n in (1, 2)]


def test_items_of_a_log_may_come_before_their_definition() -> None:
    spot, base = with_log("spot"), with_log("base")
    definition, item = to_log(spot, b"1")
    asked = carry([item], "spot", base)
    # from all: the source may be out of reach
    assert [(decode(one.payload), one.peer) for one in asked if isinstance(one, ToMesh)] == [(Want([STRING]), None)]
    (again,) = base.tick(REQUEST_RETRY_S)
    assert isinstance(again, ToMesh)
    assert again.peer is None
    assert carry([definition], "spot", base) == [
        ToRos("/spot/mesh_comm/base/artifact", STRING, "string data", False, b"1")
    ]


def test_any_robot_that_has_the_type_answers_for_the_source_of_a_log() -> None:
    spot, husky, base = with_log("spot"), with_log("husky"), with_log("base")
    to_bob(husky, b"the same type")
    _, item = to_log(spot, b"1")
    answers = carry(carry([item], "spot", base), "base", husky)
    assert carry(answers, "husky", base) == [ToRos("/spot/mesh_comm/base/artifact", STRING, "string data", False, b"1")]


def test_a_message_to_a_log_goes_to_its_readers_whatever_robot_its_name_has() -> None:
    spot = with_log("spot")
    sent = [one for one in to_log(spot, b"1", peer="base") if isinstance(one, ToMesh)]
    assert {one.peer for one in sent} == {None}


def test_no_item_of_a_log_is_left_out_for_a_later_one_or_sent_again_to_late_joiners() -> None:
    spot, base = with_log("spot"), with_log("base")
    first, second = to_log(spot, b"1", latched=True), to_log(spot, b"2", latched=True)
    shown = carry([*first[:1], *second, *first[1:]], "spot", base)
    assert [one.payload for one in shown if isinstance(one, ToRos)] == [b"2", b"1"]
    hello = encode(Hello({}, False))
    assert spot.from_mesh("base", EXCHANGE, "bridge", hello, 0.0) == []


def test_a_damaged_definition_in_a_log_is_reported() -> None:
    (note,) = with_log("base").from_mesh("spot", "artifact", "bridge", b"\xff", 0.0)
    assert isinstance(note, Note)
    assert "invalid message from spot on artifact" in note.text
    # an ordinary topic has none
    assert with_log("base").from_mesh("spot", "status", "bridge", b"\xff", 0.0) == []
