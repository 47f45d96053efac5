"""A legacy robot on a lossy link: its program never retransmits, so our acknowledgments must keep it going."""

from __future__ import annotations

import random
from collections import Counter, deque
from dataclasses import replace

import pytest

from tests.udp_mesh.core.legacy_program import LegacyProgram
from tests.udp_mesh.core.pair import World, settings
from tests.udp_mesh.core.test_legacy import OLD, OldRobot, fragments
from udp_mesh.core.events import MessageDelivered, MessageExpired, MessageReceived
from udp_mesh.core.interfaces import Datagram
from udp_mesh.core.legacy.acks import LegacyAcks, ReceivePosition
from udp_mesh.core.legacy.peers import MAX_TOPICS, SETTLE_S
from udp_mesh.core.settings import Neighbour, Outbox, Topic
from udp_mesh.wire.legacy import (
    Host,
    LegacyAck,
    LegacyPayload,
    PriorityMeshData,
    decode_legacy,
    encode_legacy,
    encode_mesh_data,
)

DELAY_S, TICK_S = 0.010, 0.001


def play(
    loss: float,
    seconds: float,
    *,
    seed: int = 1,
    restart_at: float | None = None,
    down_s: float = 0.0,
    saved_before_s: float = 0.0,
) -> tuple[int, int, LegacyProgram]:
    """Send ten urgent messages and twenty bulk messages a second; returns how many of each arrived. Our node restarts
    with what it saved `saved_before_s` earlier."""
    rng, old, program = random.Random(seed), OldRobot(), LegacyProgram()
    started = old.now
    wire: deque[tuple[float, LegacyPayload]] = deque()
    back: deque[tuple[float, LegacyAck]] = deque()
    urgent = bulk = tick = 0
    saved: dict[str, ReceivePosition] = {}
    while old.now < started + seconds + 2.0:
        if old.now < started + seconds:
            if tick % 100 == 0:
                program.push(0, b"urgent%d" % tick)
            if tick % 50 == 0:
                program.push(5, b"bulk%d" % tick + bytes(2000))
        if tick % 1000 == 0:
            old.say(Host("old", "10.0.0.9"))
        if restart_at is not None and tick == int((restart_at - saved_before_s) * 1000):
            saved = old.node.legacy_positions()
        if restart_at is not None and tick == int(restart_at * 1000):
            for _ in range(int(down_s * 1000)):
                # What it sends meanwhile is lost: three fragments, then its slots are taken.
                program.fill_in_flight(old.now)
                old.now += TICK_S
            wire.clear()
            back.clear()
            old = OldRobot(now=old.now, positions=saved)
        sent = program.fill_in_flight(old.now)
        wire.extend((old.now + DELAY_S, fragment) for fragment in sent if rng.random() >= loss)
        while wire and wire[0][0] <= old.now:
            old.say(wire.popleft()[1])
        while back and back[0][0] <= old.now:
            program.on_ack(back.popleft()[1])
        for answer in old.hear():
            if isinstance(answer, LegacyAck) and rng.random() >= loss:
                back.append((old.now + DELAY_S, answer))
        for event in old.events():
            if isinstance(event, MessageReceived):
                urgent += event.payload.startswith(b"urgent")
                bulk += event.payload.startswith(b"bulk")
        tick += 1
        old.now += TICK_S
    return urgent, bulk, program


@pytest.mark.parametrize("seed", [1, 2])
def test_a_legacy_sender_loses_only_what_the_link_loses(seed: int) -> None:
    urgent, bulk, program = play(0.01, 20.0, seed=seed)
    assert urgent >= 192
    assert bulk >= 370
    assert program.flushed == 0


def test_a_legacy_sender_loses_nothing_and_frees_every_slot_without_loss() -> None:
    urgent, bulk, program = play(0.0, 10.0)
    assert urgent >= 100
    assert bulk >= 200
    assert program.flushed == 0
    assert program.queue == []
    assert program.in_flight == {}


@pytest.mark.parametrize("seed", range(1, 5))
@pytest.mark.parametrize("saved_before_s", [0.0, 1.0])
def test_our_restart_does_not_stall_a_legacy_sender(seed: int, saved_before_s: float) -> None:
    """Fragments sent while our node was down take all of its three slots. A killed node knows an older position."""
    urgent, _, program = play(0.02, 15.0, seed=seed, restart_at=7.0, down_s=2.0, saved_before_s=saved_before_s)
    assert urgent >= 125
    assert program.flushed == 0


def test_a_restored_position_is_probed_forward_until_a_fragment_arrives() -> None:
    """The more was sent after it was saved, the further; each heartbeat starts again."""
    old = OldRobot(positions={"old": ReceivePosition(17, ((16, 2, 2), (17, 1, 9)))})
    found: set[int] = set()
    longest = 0
    for _ in range(100):
        acks = [answer for answer in old.hear() if isinstance(answer, LegacyAck)]
        longest = max(longest, len(acks))
        found.update(ack.sequence for ack in acks)
        old.now += 0.01
    assert {17, 18, 57, 100, 600} <= found
    assert max(found) < 700
    assert longest <= 200
    old.say(fragments(900, b"new")[0])
    old.now += 30.0
    old.hear()
    old.say(Host("old", "10.0.0.9"))
    assert len([answer for answer in old.hear() if isinstance(answer, LegacyAck)]) <= 20


def test_a_message_that_its_sender_has_dropped_is_not_acknowledged_for_ever() -> None:
    acks, number = LegacyAcks(), 20
    acks.on_fragment(LegacyPayload(number, 1, 9, bytes(1400), wants_ack=True), 0.0)
    unfinished = {LegacyAck(number, position) for position in (2, 3, 4)}
    # its sender waits 10 s for the acknowledgment of a fragment
    assert unfinished < set(acks.heartbeat(9.9))
    later = acks.heartbeat(40.0)
    assert not unfinished & set(later)
    # the next message may have been sent at any time, and lost
    assert {LegacyAck(number + 1, position) for position in range(3)} < set(later)
    acks.on_fragment(LegacyPayload(number, 2, 9, bytes(1400), wants_ack=True), 41.0)
    assert LegacyAck(number, 3) in acks.heartbeat(42.0)


def test_extra_acknowledgements_stay_few_without_loss() -> None:
    """One repetition each and some predictions per second: no more airtime than that."""
    acks, now, more = LegacyAcks(), 0.0, 0
    for sequence in range(1, 1001):
        fragment = LegacyPayload(sequence, 0, 1, b"x", wants_ack=True)
        more += len(acks.on_fragment(fragment, now))
        now += 0.005
        more += len(acks.due(now))
    assert more <= 1000 + 6 * 5.0 / 0.05 + 24


def legacy(*topics: Topic) -> OldRobot:
    return OldRobot(topics=(Topic("map", priority=9), *topics))


def test_outbox_messages_wait_until_a_legacy_robot_has_started() -> None:
    """It acknowledges before its reader has subscribed: what arrives before that is lost."""
    old = legacy(Topic("kept", priority=8, outbox=Outbox.ALL))
    old.now += 20.0
    old.hear()
    old.events()
    for number in range(40):
        old.node.send("kept", b"%d" % number, destination="old", now=old.now)
    assert not old.hear_payloads()
    old.say(Host("old", "10.0.0.9"))
    heard_at, left_at, left = old.now, [], 0
    while old.now < heard_at + SETTLE_S + 5.0:
        if int(old.now * 100) % 100 == 0:
            old.say(Host("old", "10.0.0.9"))
        for fragment in old.hear_payloads():
            left_at.append(old.now)
            old.say(LegacyAck(fragment.sequence, fragment.position))
        left += sum(isinstance(event, MessageDelivered) for event in old.events())
        old.now += 0.01
    assert min(left_at) >= heard_at + SETTLE_S
    assert left == 40


def test_a_bridges_own_messages_are_not_sent_to_legacy_robots() -> None:
    old = OldRobot()
    for type_name in ("bridge", "zenoh", "std_msgs/msg/String RIHS01_ab"):
        old.node.send("map", b"{}", destination="old", now=old.now, type_name=type_name)
        old.node.send("map", b"{}", now=old.now, type_name=type_name)
    old.node.send("map", b"fine", destination="old", now=old.now, type_name="std_msgs/String abc")
    assert len(old.hear_messages()) == 1
    assert sum(isinstance(event, MessageExpired) for event in old.events()) == 3


@pytest.mark.parametrize(
    ("topic", "kind"), [("~mesh/ping", "a/B"), ("a b", "a/B"), ("chat", "B"), ("1", "a/B"), ("a//b", "a/B")]
)
def test_only_valid_ros_names_are_accepted_from_legacy_robots(topic: str, kind: str) -> None:
    old = OldRobot()
    body = encode_mesh_data(PriorityMeshData("old", kind, 1, topic, b"x"))
    old.say(LegacyPayload(1, 0, 1, body, wants_ack=True))
    assert old.received() == []


def test_topics_created_by_a_legacy_robot_are_capped() -> None:
    old = OldRobot()
    for number in range(MAX_TOPICS + 50):
        body = encode_mesh_data(PriorityMeshData("old", "a/B", 1, f"t{number}", b"x"))
        old.say(LegacyPayload(number + 1, 0, 1, body, wants_ack=True))
    assert len(old.received()) == MAX_TOPICS
    old.say(fragments(2000, b"x")[0])
    assert old.node.conditions(old.now).counters.dropped_over_limit == 51


def test_datagrams_from_another_port_of_a_legacy_robot_are_ignored() -> None:
    old = OldRobot()
    old.node.receive(encode_legacy(fragments(1, b"forged")[0]), "mesh", (OLD[0], 4444), old.now)
    assert old.received() == []
    old.node.send("map", b"x", destination="old", now=old.now)
    assert len(old.hear_messages()) == 1


def test_status_reports_the_rates_to_and_from_a_legacy_robot() -> None:
    world = World(seed=1)
    config = replace(settings("new"), neighbours=(Neighbour(OLD, name="old", legacy=True),))
    world.add(config, address="10.0.0.1")

    def answer(name: str, datagram: Datagram, now: float) -> None:
        if datagram.destination == OLD:
            fragment = decode_legacy(datagram.data)
            if isinstance(fragment, LegacyPayload):
                ack = encode_legacy(LegacyAck(fragment.sequence, fragment.position))
                world.at(now + 0.005, lambda: world.nodes["new"].receive(ack, "mesh", OLD, world.now))

    world.tap = answer

    def send() -> None:
        world.nodes["new"].receive(encode_legacy(Host("old", OLD[0])), "mesh", OLD, world.now)
        world.nodes["new"].send("map", bytes(12_500), destination="old", now=world.now)
        world.at(world.now + 0.1, send)

    send()
    world.run(5.0)
    conditions = world.nodes["new"].conditions(world.now)
    (peer,) = conditions.peers
    assert 0.8e6 < peer.sent_bits_per_s < 1.5e6
    assert 0.8e6 < peer.delivered_bits_per_s < 1.5e6
    assert peer.received_bits_per_s > 10_000
    assert 0.8e6 < conditions.sent_bits_per_s < 1.5e6


def test_spurious_resends_raise_the_resend_timeout() -> None:
    """The legacy program answers when its interpreter is scheduled."""
    old = OldRobot()
    rng = random.Random(2)
    answers: list[tuple[float, LegacyAck]] = []
    sent = resent = 0
    seen: set[tuple[int, int]] = set()
    for tick in range(60_000):
        if tick % 100 == 0:
            old.node.send("stop", b"%d" % tick, destination="old", now=old.now)
        if tick % 1000 == 0:
            old.say(Host("old", "10.0.0.9"))
        for fragment in old.hear_payloads():
            sent += 1
            resent += (fragment.sequence, fragment.position) in seen
            seen.add((fragment.sequence, fragment.position))
            delay_s = 0.004 if rng.random() < 0.9 else 0.07
            answers.append((old.now + delay_s, LegacyAck(fragment.sequence, fragment.position)))
        for at, ack in list(answers):
            if at <= old.now:
                answers.remove((at, ack))
                old.say(ack)
        old.events()
        old.now += 0.001
    assert len(seen) >= 1180
    assert resent <= 20


@pytest.mark.parametrize("seed", [1, 2])
def test_a_lost_acknowledgement_rarely_delivers_duplicates_to_a_legacy_robot(seed: int) -> None:
    """It does not remember finished messages: with one fragment per message, over a hundred arrived twice."""
    rng, old, program = random.Random(seed), OldRobot(), LegacyProgram()
    wire: deque[tuple[float, LegacyPayload]] = deque()
    back: deque[tuple[float, LegacyAck]] = deque()
    arrived: Counter[bytes] = Counter()
    delivered = tick = 0
    while tick < 23_000:
        if tick % 10 == 0 and tick < 20_000:
            old.node.send("stop", b"%d" % tick, destination="old", now=old.now)
        if tick % 1000 == 0:
            old.say(Host("old", "10.0.0.9"))
            program.prune(old.now)
        wire.extend((old.now + DELAY_S, fragment) for fragment in old.hear_payloads() if rng.random() >= 0.05)
        while wire and wire[0][0] <= old.now:
            ack, message = program.on_fragment(wire.popleft()[1], old.now)
            if message is not None:
                arrived[message.data] += 1
            if rng.random() >= 0.05:
                back.append((old.now + DELAY_S, ack))
        while back and back[0][0] <= old.now:
            old.say(back.popleft()[1])
        delivered += sum(isinstance(event, MessageDelivered) for event in old.events())
        tick += 1
        old.now += TICK_S
    assert len(arrived) == delivered == 2_000
    assert arrived.total() - len(arrived) <= 12
