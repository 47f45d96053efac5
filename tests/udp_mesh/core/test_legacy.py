"""Peers of the legacy format, and a test for each known defect of the legacy system."""

from __future__ import annotations

import random
from collections.abc import Mapping
from dataclasses import replace

import pytest

from tests.udp_mesh.core.pair import BROADCAST, KEY, World, pair, settings
from udp_mesh.core.endpoint import Endpoint
from udp_mesh.core.events import (
    Event,
    MessageDelivered,
    MessageReceived,
    NameConflict,
    PeerOffline,
    PeerOnline,
    Rejected,
    RejectReason,
)
from udp_mesh.core.interfaces import Datagram
from udp_mesh.core.legacy.acks import ReceivePosition
from udp_mesh.core.legacy.reassembly import LegacyReassembly
from udp_mesh.core.legacy.sender import LAST_SEQUENCE
from udp_mesh.core.settings import Limits, LinkInfo, LinkKind, Neighbour, Settings, Topic
from udp_mesh.wire.legacy import (
    Host,
    LegacyAck,
    LegacyPayload,
    PriorityMeshData,
    decode_legacy,
    decode_mesh_data,
    encode_legacy,
    encode_mesh_data,
    fragment_legacy,
)

OLD = ("10.0.0.9", 8700)


class OldRobot:
    """Our node with one legacy neighbor `old`, which the test plays."""

    def __init__(
        self, *, now: float = 1000.0, positions: Mapping[str, ReceivePosition] | None = None, **changes: object
    ) -> None:
        self.now = now
        rng = random.Random(3)
        config = settings("new", Topic("stop", priority=0), Topic("map", priority=9), **changes)
        config = replace(config, neighbours=(Neighbour(OLD, name="old", legacy=True),))
        self.node = Endpoint(config, boot_id=rng.randbytes(16), rng=rng, now=self.now, legacy_positions=positions or {})
        self.node.link_up(LinkInfo("mesh", LinkKind.BROADCAST, ("10.0.0.1", 8700), ("10.0.0.255", 8700)), self.now)
        self.say(Host("old", "10.0.0.9"))
        self.events()

    def say(self, datagram: Host | LegacyPayload | LegacyAck) -> None:
        self.node.receive(encode_legacy(datagram), "mesh", OLD, self.now)

    def hear(self) -> list[Host | LegacyPayload | LegacyAck]:
        """What is sent to the old robot now."""
        self.node.handle_timer(self.now)
        out: list[Datagram] = []
        while datagrams := self.node.datagrams_to_send(self.now):
            out.extend(datagrams)
        due = self.node.next_timer()
        assert due is not None
        assert due > self.now, "what is due was done, but the next timer is still in the past"
        return [decode_legacy(datagram.data) for datagram in out if datagram.destination == OLD]

    def hear_payloads(self) -> list[LegacyPayload]:
        return [datagram for datagram in self.hear() if isinstance(datagram, LegacyPayload)]

    def hear_messages(self) -> list[LegacyPayload]:
        """The first fragments of what is sent to the old robot now."""
        return [fragment for fragment in self.hear_payloads() if fragment.position == 0]

    def events(self) -> list[Event]:
        events = []
        while (event := self.node.next_event()) is not None:
            events.append(event)
        return events

    def received(self) -> list[MessageReceived]:
        return [event for event in self.events() if isinstance(event, MessageReceived)]


def message(data: bytes, topic: str = "chat", priority: int = 4) -> list[bytes]:
    return fragment_legacy(encode_mesh_data(PriorityMeshData("old", "std_msgs/String", priority, topic, data)))


def fragments(sequence: int, data: bytes, *, wants_ack: bool = True) -> list[LegacyPayload]:
    chunks = message(data)
    return [LegacyPayload(sequence, place, len(chunks), chunk, wants_ack) for place, chunk in enumerate(chunks)]


def test_messages_go_to_a_legacy_peer_in_its_own_format_with_their_priority() -> None:
    old = OldRobot()
    sent_type = "std_msgs/Empty d41d8cd98f00b204e9800998ecf8427e"
    old.node.send("stop", b"halt", destination="old", now=old.now, type_name=sent_type)
    fragment, empty = old.hear_payloads()
    assert (empty.sequence, empty.position, empty.data) == (fragment.sequence, 1, b"")
    events = decode_mesh_data(fragment.data)
    assert (events.host, events.topic, events.type_name, events.priority, events.data) == (
        "new",
        "stop",
        "std_msgs/Empty",
        0,
        b"halt",
    )
    old.say(LegacyAck(fragment.sequence, 0))
    assert old.events() == []
    old.say(LegacyAck(fragment.sequence, 1))
    assert [type(event) for event in old.events()] == [MessageDelivered]


def test_messages_of_a_legacy_peer_arrive_and_are_acknowledged() -> None:
    old = OldRobot()
    for fragment in reversed(fragments(5, b"x" * 4000)):
        old.say(fragment)
    acks = [answer for answer in old.hear() if isinstance(answer, LegacyAck)]
    assert {(ack.sequence, ack.position) for ack in acks} == {(5, 0), (5, 1), (5, 2), (5, 3)}
    (event,) = old.received()
    assert old.node.conditions(old.now).counters.messages_received == 1
    # Nothing authenticates them: they and the heartbeat count toward a flood.
    assert old.node.unauthenticated == 5
    assert (event.source, event.topic, event.payload, event.priority) == ("old", "chat", b"x" * 4000, 4)


def test_the_address_and_link_of_a_legacy_peer_are_reported() -> None:
    old = OldRobot()
    (peer,) = old.node.conditions(old.now + 2).peers
    assert (peer.name, peer.online, peer.address, peer.link, peer.last_heard) == ("old", True, OLD, "mesh", old.now)


def test_a_removed_neighbor_is_forgotten_unless_heard_or_with_queued_messages() -> None:
    old = OldRobot()
    named = old.node._state.settings
    others = tuple(
        Neighbour((f"10.0.0.{host}", OLD[1]), name=name, legacy=True) for host, name in ((21, "typo"), (22, "away"))
    )
    old.node.apply(replace(named, neighbours=(*named.neighbours, *others)), old.now)
    old.node.send("map", b"for later", destination="away", now=old.now)
    assert {peer.name for peer in old.node.conditions(old.now).peers} == {"old", "typo", "away"}
    old.node.apply(replace(named, neighbours=()), old.now)
    assert {peer.name for peer in old.node.conditions(old.now).peers} == {"old", "away"}
    old.hear()


def test_a_broadcast_of_a_legacy_peer_arrives_without_an_acknowledgement() -> None:
    old = OldRobot()
    old.say(fragments(0x8001, b"all", wants_ack=False)[0])
    assert not [answer for answer in old.hear() if isinstance(answer, LegacyAck)]
    assert [event.broadcast for event in old.received()] == [True]


def test_three_fragments_are_in_flight_to_a_legacy_peer_and_urgent_ones_go_first() -> None:
    old = OldRobot()
    old.node.send("map", bytes(20_000), destination="old", now=old.now)
    first = old.hear_payloads()
    assert len(first) == 3
    old.node.send("stop", b"!", destination="old", now=old.now)
    (urgent,) = old.hear_messages()
    assert decode_mesh_data(urgent.data).topic == "stop"


def test_a_broadcast_reaches_legacy_peers() -> None:
    old = OldRobot()
    old.node.send("stop", b"all", now=old.now)
    assert [decode_mesh_data(fragment.data).data for fragment in old.hear_messages()] == [b"all"]


# The defects, in the order listed in the facts about the legacy system.


def test_defect_1_a_lost_fragment_is_retransmitted_without_a_stall() -> None:
    old = OldRobot()
    old.node.send("map", bytes(6000), destination="old", now=old.now)
    seen: set[int] = set()
    dropped = False
    for _ in range(200):
        for fragment in old.hear_payloads():
            if fragment.position == 1 and not dropped:
                dropped = True
                continue
            seen.add(fragment.position)
            old.say(LegacyAck(fragment.sequence, fragment.position))
        old.now += 0.01
        if any(isinstance(event, MessageDelivered) for event in old.events()):
            break
    assert dropped
    assert seen == {0, 1, 2, 3, 4}


def test_defect_2_memory_is_not_allocated_from_a_claimed_fragment_count() -> None:
    reassembly = LegacyReassembly(Limits())
    reassembly.add(LegacyPayload(1, 0, 65_536, b"x", wants_ack=True), 0.0)
    assert reassembly.bytes < 1000


def test_defect_3_a_fragment_past_its_total_is_counted_and_dropped() -> None:
    old = OldRobot()
    raw = bytearray(encode_legacy(LegacyPayload(1, 0, 2, b"x", wants_ack=True)))
    raw[3:7] = (7).to_bytes(4, "little")
    old.node.receive(bytes(raw), "mesh", OLD, old.now)
    assert old.node.conditions(old.now).counters.dropped_malformed == 1
    old.say(fragments(2, b"fine")[0])
    assert [event.payload for event in old.received()] == [b"fine"]


@pytest.mark.parametrize("kind", [0, 3, 6, 77, 127])
def test_defect_4_an_unknown_type_is_counted_and_dropped(kind: int) -> None:
    old = OldRobot()
    raw = bytearray(encode_legacy(Host("old", "10.0.0.9")))
    raw[0] = kind
    old.node.receive(bytes(raw), "mesh", OLD, old.now)
    old.say(fragments(2, b"fine")[0])
    assert [event.payload for event in old.received()] == [b"fine"]


def test_defect_4_broadcasts_do_not_crash_a_legacy_program() -> None:
    world = World(seed=9)
    legacy = Neighbour(("10.0.0.50", 8700), name="old", legacy=True)
    topic = Topic("cast", repair=True)
    world.add(settings("a", topic, neighbours=(legacy,)))
    world.add(settings("b", topic))
    to_all: list[Datagram] = []

    def tap(name: str, datagram: Datagram, now: float) -> None:
        if name == "a" and datagram.destination in (None, BROADCAST):
            to_all.append(datagram)

    world.tap = tap
    assert world.run(5.0, until=lambda: bool(world.events_of("a", PeerOnline) and world.events_of("b", PeerOnline)))
    for size in (0, 100, 1300, 1380, 1400, 3000):
        world.send("a", "cast", bytes(size))
        world.run(0.5)
    world.nodes["a"].close(world.now)
    world.run(0.1)
    assert len(to_all) > 10
    for datagram in to_all:
        assert decode_legacy(datagram.data) == LegacyAck(0xFFFF, 0xFFFFFFFF)
        assert len(datagram.data) <= 1500 - 28
    assert [
        len(event.payload) for event in world.events_of("b", MessageReceived) if isinstance(event, MessageReceived)
    ] == [
        0,
        100,
        1300,
        1380,
        1400,
        3000,
    ]
    assert world.events_of("b", PeerOffline)


def test_defect_5_an_announced_name_is_not_trusted() -> None:
    old = OldRobot()
    old.say(Host("base", "10.0.0.9"))
    old.say(fragments(2, b"who")[0])
    assert [event.source for event in old.received()] == ["old"]
    stranger = ("10.0.0.66", 8700)
    old.node.receive(encode_legacy(Host("old", "10.0.0.66")), "mesh", stranger, old.now)
    old.node.receive(encode_legacy(fragments(3, b"forged")[0]), "mesh", stranger, old.now)
    assert old.received() == []
    assert old.node.conditions(old.now).counters.dropped_unauthenticated == 2


def test_defect_5_a_name_conflict_between_our_own_nodes_is_reported() -> None:
    world = World()
    world.add(settings("a"))
    world.add(settings("b"))
    world.run(4.0)
    impostor = replace(settings("b"), keys=(KEY,))
    real = world.nodes.pop("b")
    world.addresses["b2"] = ("10.0.0.77", 8700)
    fake = Endpoint(impostor, boot_id=world.rng.randbytes(16), rng=world.rng, now=world.now)
    fake.link_up(LinkInfo("mesh", LinkKind.BROADCAST, ("10.0.0.77", 8700), ("10.0.0.255", 8700)), world.now)
    world.nodes["b"] = real
    world.nodes["b2"] = fake
    world.events["b2"] = []
    for other in ("a", "b"):
        world.pipes[("b2", other)] = world.pipes[("a", "b")]
        world.pipes[(other, "b2")] = world.pipes[("a", "b")]
    assert world.run(20.0, until=lambda: bool(world.events_of("a", NameConflict)))
    assert [event.name for event in world.events_of("a", NameConflict) if isinstance(event, NameConflict)] == ["b"]
    assert world.run(5.0, until=lambda: bool(world.events_of("b", NameConflict)))
    assert any(event.own for event in world.events_of("b", NameConflict) if isinstance(event, NameConflict))


@pytest.mark.parametrize("broadcast", ["10.0.15.255", "10.0.0.15", "192.168.255.255"])
def test_defect_6_the_configured_broadcast_address_is_used(broadcast: str) -> None:
    both = pair()
    both.a.link_up(LinkInfo("mesh", LinkKind.BROADCAST, ("10.0.0.1", 8700), (broadcast, 8700)), both.now)
    both.now += 2.0
    assert {datagram.destination for datagram in both.drop(both.a)} == {(broadcast, 8700)}


def test_defect_7_each_partial_message_is_purged_by_its_own_age() -> None:
    reassembly = LegacyReassembly(Limits())
    reassembly.add(fragments(1, bytes(2000))[0], 0.0)
    reassembly.add(fragments(2, bytes(2000))[0], 9.0)
    reassembly.purge(11.0)
    assert len(reassembly) == 1
    _, whole = reassembly.add(fragments(2, bytes(2000))[1], 11.0)
    assert whole is not None


def test_nothing_is_held_of_a_complete_or_purged_message() -> None:
    reassembly = LegacyReassembly(Limits())
    for fragment in (*fragments(1, bytes(2000)), fragments(2, bytes(2000))[0]):
        reassembly.add(fragment, 0.0)
    assert reassembly.bytes > 0
    reassembly.purge(11.0)
    assert reassembly.bytes == 0


def test_defect_8_a_reused_sequence_number_is_not_merged_with_an_old_partial_message() -> None:
    reassembly = LegacyReassembly(Limits())
    reassembly.add(fragments(7, b"a" * 2000)[0], 0.0)
    fresh = fragments(7, b"b" * 3000)
    wholes = [reassembly.add(fragment, 1.0)[1] for fragment in fresh]
    assert wholes[-1] is not None
    assert wholes[-1].data == b"b" * 3000


def test_defect_8_a_number_still_in_use_is_not_given_to_a_new_message() -> None:
    old = OldRobot()
    old.node.send("map", b"held", destination="old", now=old.now)
    (held,) = old.hear_messages()
    sender = next(iter(old.node._legacy.by_host.values())).sender
    sender._sequence = (held.sequence - 2) % LAST_SEQUENCE
    numbers = {sender._next_sequence() for _ in range(3)}
    assert held.sequence not in numbers


def test_defect_9_priority_order_survives_the_wrap_of_the_sequence_numbers() -> None:
    old = OldRobot()
    sender = next(iter(old.node._legacy.by_host.values())).sender
    sender._sequence = LAST_SEQUENCE - 1
    for number in range(6):
        old.node.send("map", bytes([number]), destination="old", now=old.now)
    order = []
    for _ in range(6):
        for fragment in old.hear_payloads():
            if fragment.position == 0:
                order.append(decode_mesh_data(fragment.data).data[0])
            old.say(LegacyAck(fragment.sequence, fragment.position))
    assert order == sorted(order)


def test_defect_10_a_send_to_an_unknown_host_is_rejected_and_the_node_keeps_running() -> None:
    old = OldRobot()
    answer = old.node.send("map", b"x", destination="nobody", now=old.now)
    assert isinstance(answer, Rejected)
    assert answer.reason is RejectReason.UNKNOWN_PEER
    old.node.send("map", b"x", destination="old", now=old.now)
    assert len(old.hear_messages()) == 1


@pytest.mark.parametrize("fragments", [1, 2, 3])
def test_defect_11_an_exact_multiple_of_the_fragment_size_sends_no_empty_fragment(fragments: int) -> None:
    both = pair(Topic("t"), fragment_bytes=100)
    # The first fragment reserves room for its head and the topic announcement.
    both.a.send("t", b"learn the name", destination="b", now=both.now)
    both.roundtrip(times=5)
    both.events(both.b)
    size = 100 - 16 + 100 * (fragments - 1)
    both.a.send("t", bytes(size), destination="b", now=both.now)
    before = both.b.conditions(both.now).counters.fragments_received
    both.roundtrip(times=20)
    assert both.b.conditions(both.now).counters.fragments_received == before + fragments
    assert [event.payload for event in both.events(both.b) if isinstance(event, MessageReceived)] == [bytes(size)]


def test_defect_11_the_legacy_receiver_still_gets_the_empty_fragment_it_counts_on() -> None:
    overhead = len(encode_mesh_data(PriorityMeshData("new", "", 9, "map", b"")))
    old = OldRobot()
    old.node.send("map", bytes(1300 - overhead), destination="old", now=old.now)
    assert [len(fragment.data) for fragment in old.hear_payloads()] == [1300, 0]


def test_a_duplicate_fragment_of_a_finished_message_is_only_acknowledged() -> None:
    old = OldRobot()
    for fragment in fragments(5, b"x" * 2000) * 2:
        old.say(fragment)
    assert len(old.received()) == 1
    assert len([answer for answer in old.hear() if isinstance(answer, LegacyAck)]) == 4


def test_a_silent_legacy_peer_is_probed_gently_and_loses_nothing() -> None:
    old = OldRobot()
    old.node.send("map", bytes(20_000), destination="old", now=old.now)
    sent = 0
    for _ in range(800):
        sent += len(old.hear_payloads())
        old.now += 0.01
    assert 20 < sent < 60
    old.say(Host("old", "10.0.0.9"))
    delivered = False
    for _ in range(400):
        for fragment in old.hear_payloads():
            old.say(LegacyAck(fragment.sequence, fragment.position))
        delivered = delivered or any(isinstance(event, MessageDelivered) for event in old.events())
        old.now += 0.01
    assert delivered


def test_legacy_datagrams_are_dropped_without_legacy_neighbors() -> None:
    both = pair()
    both.b.receive(encode_legacy(Host("x", "10.0.0.9")), "mesh", OLD, both.now)
    assert both.events(both.b) == []


def test_a_legacy_neighbor_requires_a_name() -> None:
    with pytest.raises(ValueError, match="requires a name"):
        Neighbour(OLD, legacy=True)
    assert isinstance(settings("x"), Settings)
    assert PeerOnline is not None


def test_a_restarted_legacy_program_that_reuses_sequence_numbers_is_received() -> None:
    old = OldRobot()
    for sequence in (1, 2):
        for fragment in fragments(sequence, b"x" * 2000):
            old.say(fragment)
    assert len(old.received()) == 2
    # The second message of the next run is cut off in the middle by another restart.
    old.now += 5.0
    for fragment in [*fragments(1, b"y" * 2000), *fragments(2, b"y" * 2000)[:1]]:
        old.say(fragment)
    old.now += 5.0
    for sequence in (1, 2):
        for fragment in fragments(sequence, b"z" * 2000):
            old.say(fragment)
    assert [event.payload[:1] for event in old.received()] == [b"y", b"z", b"z"]


def test_a_message_above_the_limit_does_not_stall_a_legacy_sender() -> None:
    old = OldRobot(limits=Limits(message_bytes=5000))
    for fragment in [*fragments(1, bytes(20_000)), *fragments(2, b"small")]:
        old.say(fragment)
    assert [event.payload for event in old.received()] == [b"small"]
    assert (
        len([answer for answer in old.hear() if isinstance(answer, LegacyAck)]) == len(fragments(1, bytes(20_000))) + 1
    )


def test_each_run_starts_at_a_random_legacy_sequence_number() -> None:
    numbers = set()
    for seed in range(5):
        rng = random.Random(seed)
        config = replace(settings("new"), neighbours=(Neighbour(OLD, name="old", legacy=True),))
        node = Endpoint(config, boot_id=rng.randbytes(16), rng=rng, now=0.0)
        numbers.add(next(iter(node._legacy.by_host.values())).sender._next_sequence())
    assert len(numbers) == 5
    assert all(1 <= number <= LAST_SEQUENCE for number in numbers)


def test_a_link_without_ipv4_is_not_announced_in_the_legacy_format() -> None:
    old = OldRobot()
    old.node.link_up(
        LinkInfo("six", LinkKind.BROADCAST, ("fe80::1234:5678:9abc:def0", 8700), ("ff02::1", 8700)), 1000.0
    )
    old.now += 2.0
    assert [beat.address for beat in old.hear() if isinstance(beat, Host)] == ["10.0.0.1"]
