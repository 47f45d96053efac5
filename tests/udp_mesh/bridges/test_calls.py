"""Calls across the mesh, without ROS: each ends exactly once, and a caller learns why."""

from __future__ import annotations

from collections.abc import Iterable

from hypothesis import given
from hypothesis import strategies as st

from udp_mesh.bridges.call_messages import (
    Call,
    CallMessage,
    CallMessageError,
    Event,
    Offer,
    Offers,
    Reply,
    decode_call_message,
    encode_call_message,
)
from udp_mesh.bridges.calls import (
    AddProxy,
    CallEffect,
    Calls,
    Deliver,
    Finish,
    Invoke,
    RemoveProxy,
    SendCall,
    Warn,
)

MAP = Offer("/get_map", "nav_msgs/srv/GetMap", "", 5.0)
RESULT = Offer("/move/_action/get_result", "pkg/action/Move_GetResult", "", 0.0, 30.0)
NAMES = st.text(max_size=20)
MESSAGES: st.SearchStrategy[CallMessage] = st.one_of(
    st.builds(
        Offers,
        NAMES,
        st.lists(st.builds(Offer, NAMES, NAMES, NAMES, st.floats(0, 99), st.floats(0, 99)), max_size=3).map(tuple),
        st.booleans(),
    ),
    st.builds(Call, NAMES, st.integers(0, 2**40), NAMES, st.binary(max_size=50)),
    st.builds(Reply, NAMES, st.integers(0, 2**40), NAMES, st.binary(max_size=50)),
    st.builds(Event, NAMES, st.binary(max_size=50)),
)


def carry(effects: Iterable[CallEffect], to: Calls, source: str) -> list[CallEffect]:
    """What the other side does with the messages among these effects."""
    return [made for each in effects if isinstance(each, SendCall) for made in to.from_mesh(source, each.payload)]


def pair(*offers: Offer) -> tuple[Calls, Calls]:
    """A base, and a robot that offers; both are online for each other."""
    base, robot = Calls("b1"), Calls("r1")
    robot.offer(offers, [("/move/_action/feedback", RESULT.name)])
    answered = carry(base.on_daemon_up(["robot"]), robot, "base")
    added = carry(answered, base, "robot")
    assert added == [AddProxy("robot", offer) for offer in offers]
    return base, robot


def finished(effects: Iterable[CallEffect]) -> list[Finish]:
    return [each for each in effects if isinstance(each, Finish)]


def test_a_request_is_invoked_and_its_response_finishes_the_call() -> None:
    base, robot = pair(MAP)
    number, sent = base.call("robot", MAP.name, b"request", 0.0)
    (invoked,) = carry(sent, robot, "base")
    assert invoked == Invoke("base", "b1", number, MAP.name, b"request", 5.0)
    replied = robot.reply(invoked, b"response")
    assert carry(replied, base, "robot") == [Finish(number, "", b"response")]
    assert carry(replied, base, "robot") == []
    assert carry(sent, robot, "base") == []
    assert base.tick(100.0) == []


def test_a_call_without_a_response_ends_at_its_deadline() -> None:
    base, robot = pair(MAP)
    number, sent = base.call("robot", MAP.name, b"", 10.0)
    (invoked,) = carry(sent, robot, "base")
    assert isinstance(invoked, Invoke)
    assert base.tick(14.9) == []
    assert base.tick(15.0) == [
        Finish(number, "no response from robot within 5 s; the call may have been executed", b"")
    ]
    assert carry(robot.reply(invoked, b"late"), base, "robot") == []


def test_calls_to_a_peer_that_goes_offline_end_and_its_services_are_withdrawn() -> None:
    base, robot = pair(MAP)
    number, _ = base.call("robot", MAP.name, b"", 0.0)
    assert base.on_peer_offline("robot", 1.0) == [
        Finish(number, "robot is offline; the call may have been executed", b""),
        RemoveProxy("robot", MAP.name),
    ]
    number, refused = base.call("robot", MAP.name, b"", 2.0)
    assert refused == [Finish(number, "robot does not offer /get_map now", b"")]
    assert carry(carry(base.on_peer_online("robot"), robot, "base"), base, "robot") == [AddProxy("robot", MAP)]


def test_an_actions_result_survives_a_cut_and_is_asked_for_again() -> None:
    base, robot = pair(RESULT)
    number, sent = base.call("robot", RESULT.name, b"goal", 0.0)
    assert len(carry(sent, robot, "base")) == 1
    assert base.on_peer_offline("robot", 10.0) == []
    assert base.tick(39.9) == []
    again = carry(carry(base.on_peer_online("robot"), robot, "base"), base, "robot")
    (invoked,) = carry(again, robot, "base")
    assert isinstance(invoked, Invoke)
    assert invoked.request == b"goal"
    assert base.tick(100.0) == []
    assert finished(carry(robot.reply(invoked, b"result"), base, "robot")) == [Finish(number, "", b"result")]


def test_an_actions_result_is_given_up_after_a_long_cut() -> None:
    base, _ = pair(RESULT)
    number, _ = base.call("robot", RESULT.name, b"goal", 0.0)
    base.on_peer_offline("robot", 10.0)
    assert base.tick(40.0) == [
        Finish(number, "robot has been offline for 30 s; the call may have been executed", b""),
        RemoveProxy("robot", RESULT.name),
    ]


def test_calls_end_when_the_peers_bridge_was_started_again() -> None:
    base, _ = pair(MAP, RESULT)
    fresh = Calls("r2")
    numbers = {base.call("robot", name, b"", 0.0)[0] for name in (MAP.name, RESULT.name)}
    fresh.offer([MAP, RESULT])
    ended = finished(carry(fresh.on_daemon_up(["base"]), base, "robot"))
    assert {each.number for each in ended} == numbers
    assert all("started again" in each.error for each in ended)


def test_a_service_that_is_no_longer_offered_ends_its_calls() -> None:
    base, robot = pair(MAP)
    robot.on_peer_online("base")
    number, _ = base.call("robot", MAP.name, b"", 0.0)
    assert carry(robot.offer([]), base, "robot") == [
        Finish(number, "robot no longer offers /get_map", b""),
        RemoveProxy("robot", MAP.name),
    ]


def test_a_call_of_something_that_is_not_offered_is_answered_with_an_error() -> None:
    _, robot = pair(MAP)
    call = encode_call_message(Call("b1", 7, "/reboot", b""))
    (sent,) = robot.from_mesh("base", call)
    assert isinstance(sent, SendCall)
    assert decode_call_message(sent.payload) == Reply("b1", 7, "/reboot is not offered", b"")


def test_feedback_goes_only_to_those_who_called() -> None:
    base, robot = pair(RESULT)
    assert robot.event("/move/_action/feedback", b"x") == []
    carry(base.call("robot", RESULT.name, b"", 0.0)[1], robot, "base")
    assert carry(robot.event("/move/_action/feedback", b"x"), base, "robot") == [
        Deliver("robot", "/move/_action/feedback", b"x")
    ]


@given(MESSAGES)
def test_a_message_round_trips(message: CallMessage) -> None:
    assert decode_call_message(encode_call_message(message)) == message


@given(st.binary(max_size=200) | MESSAGES.map(encode_call_message).map(lambda data: data[: len(data) // 2]))
def test_any_bytes_are_a_message_or_a_warning(data: bytes) -> None:
    try:
        decode_call_message(data)
    except CallMessageError:
        found = Calls("x").from_mesh("robot", data)
        assert len(found) == 1
        assert isinstance(found[0], Warn)
