"""A node sends its peers what their programs read, as fast as they want it, and never less than that."""

from __future__ import annotations

import random
from itertools import pairwise

import pytest

from tests.udp_mesh.core.pair import Pipe, World, settings
from tests.udp_mesh.core.subscriptions.team import TOPICS, config, met, outcomes, read, received
from tests.udp_mesh.disk import Disk
from udp_mesh.core.events import (
    ExpiryReason,
    MessageDelivered,
    MessageExpired,
    MessageId,
    MessagePeerLost,
    MessageReceived,
)
from udp_mesh.core.settings import Log, Outbox, Settings, Topic
from udp_mesh.core.subscriptions.own import LINGER_S, STARTING_S
from udp_mesh.core.subscriptions.selection import GRACE_S

UNREAD = 100_000


def carried(world: World, source: str = "a", to: str = "b") -> int:
    return world.pipes[source, to].carried_bytes


def test_what_no_program_reads_is_not_sent_and_ends_once() -> None:
    world = met()
    before = carried(world)
    world.send("a", "map", bytes(UNREAD), "b")
    world.run(3 * GRACE_S)
    (outcome,) = outcomes(world, "a", MessageExpired, "map")
    assert isinstance(outcome, MessageExpired)
    assert (outcome.peer, outcome.reason) == ("b", ExpiryReason.NOT_WANTED)
    assert carried(world) - before < UNREAD / 20
    assert not received(world, "b", "map")
    (peer,) = world.nodes["a"].conditions(world.now).peers
    assert (peer.saved_messages, peer.saved_bytes) == (1, UNREAD)


def test_what_is_read_is_sent() -> None:
    world = met()
    read(world, "b", "ma*")
    world.run(0.5)
    world.send("a", "map", b"one", "b")
    world.run(0.5)
    assert received(world, "b", "map") == [b"one"]
    assert len(outcomes(world, "a", MessageDelivered, "map")) == 1


@pytest.mark.parametrize("topic", ["stop", "kept"])
def test_urgent_topics_and_those_marked_always_are_sent_unread(topic: str) -> None:
    world = met()
    world.send("a", topic, b"now", "b")
    world.run(0.5)
    assert received(world, "b", topic) == [b"now"]


@pytest.mark.parametrize("outbox", [Outbox.LAST, Outbox.ALL])
def test_a_topic_with_an_outbox_is_sent_though_no_program_reads_now(outbox: Outbox) -> None:
    topic = Topic("artifacts", outbox=outbox)
    world = met(config("a", topic), config("b", topic))
    world.send("a", "artifacts", b"found", "b")
    world.run(3 * GRACE_S)
    assert received(world, "b", "artifacts") == [b"found"]


def test_logs_reach_nodes_whose_programs_do_not_read() -> None:
    log = Topic("artifacts", log=Log(copies=1))
    world = met(config("a", log), config("b", log))
    world.send("a", "artifacts", b"found")
    world.run(5.0)
    assert received(world, "b", "artifacts") == [b"found"]


@pytest.mark.parametrize("old", ["a", "b"])
def test_an_old_node_beside_a_new_one_sends_and_gets_everything(old: str) -> None:
    """An earlier version announces no such feature and knows no such topics."""
    world = World()
    for name in ("a", "b"):
        world.add(settings(name, *TOPICS) if name == old else config(name))
        if name != old:
            read(world, name)
    world.run(STARTING_S + 1.0)
    for turn in range(3):
        for source, peer in (("a", "b"), ("b", "a")):
            world.send(source, "map", b"%d" % turn, peer)
        world.run(1.0)
    assert received(world, "a", "map") == received(world, "b", "map") == [b"0", b"1", b"2"]
    assert not [one for one in world.nodes if outcomes(world, one, MessageExpired, "map")]


def test_a_peer_whose_table_is_not_known_yet_gets_everything() -> None:
    world = World()
    for name in ("a", "b"):
        world.add(config(name))
        read(world, name)
    world.run(1.0)
    world.send("a", "map", b"early", "b")
    world.run(0.5)
    assert received(world, "b", "map") == [b"early"]


def test_switched_off_everything_is_sent() -> None:
    world = met()
    world.nodes["a"].apply(config("a", selective=False), world.now)
    world.send("a", "map", b"one", "b")
    world.run(0.5)
    assert received(world, "b", "map") == [b"one"]
    world.nodes["b"].apply(config("b", selective=False), world.now)
    assert world.nodes["a"].apply(config("a"), world.now) == ["selective: false -> true"]
    world.run(4.0)
    world.send("a", "map", b"two", "b")
    world.run(0.5)
    assert received(world, "b", "map") == [b"one", b"two"]


@pytest.mark.parametrize("delay_s", [0.0, 0.01, 0.1, 0.3])
def test_a_program_that_subscribed_before_the_message_was_sent_gets_it(delay_s: float) -> None:
    """The message is sent while the table that asks for it is still under way."""
    world = met()
    world.pipes["b", "a"].delay_s = 0.25
    read(world, "b", "map")
    world.run(delay_s)
    world.send("a", "map", b"first", "b")
    world.run(3 * GRACE_S)
    assert received(world, "b", "map") == [b"first"]
    assert len(outcomes(world, "a", MessageDelivered, "map")) == 1
    assert not outcomes(world, "a", MessageExpired, "map")


def test_a_program_that_comes_back_soon_misses_nothing() -> None:
    world = met()
    read(world, "b", "map")
    world.run(0.5)
    read(world, "b")
    world.run(LINGER_S / 2)
    world.send("a", "map", b"meanwhile", "b")
    read(world, "b", "map")
    world.run(LINGER_S)
    world.send("a", "map", b"later", "b")
    world.run(0.5)
    assert received(world, "b", "map") == [b"meanwhile", b"later"]


def test_what_waits_is_given_up_when_its_last_reader_leaves() -> None:
    world = met()
    read(world, "b", "map")
    world.run(0.5)
    world.pipes["a", "b"].rate_bits_per_s = 1e5
    for _ in range(20):
        world.send("a", "map", bytes(50_000), "b")
    read(world, "b")
    world.run(120.0)
    arrived, given_up = (len(outcomes(world, "a", kind, "map")) for kind in (MessageDelivered, MessageExpired))
    assert arrived + given_up == 20
    assert given_up > 15


def test_a_restarted_peer_gets_everything_until_its_programs_have_had_time_to_return() -> None:
    world = met()
    world.add(config("b"))
    read(world, "b")
    world.run(2.0)
    world.send("a", "map", b"while starting", "b")
    world.run(STARTING_S)
    assert received(world, "b", "map") == [b"while starting"]
    world.send("a", "map", b"asks", "b")
    world.run(2.0)
    world.send("a", "map", b"unread", "b")
    world.run(2.0)
    assert b"unread" not in received(world, "b", "map")


def test_a_peer_that_was_away_is_asked_again() -> None:
    """It may have failed to announce a change: its table is no longer trusted."""
    world = met()
    for pipe in world.pipes.values():
        pipe.up = False
    world.run(15.0)
    read(world, "b", "map")
    world.run(90.0)
    for pipe in world.pipes.values():
        pipe.up = True
    world.run(5.0)
    world.send("a", "map", b"one", "b")
    world.run(2.0)
    world.send("a", "map", b"two", "b")
    world.run(2.0)
    assert received(world, "b", "map") == [b"one", b"two"]


@pytest.mark.parametrize("seed", range(8))
def test_tables_arrive_over_a_link_that_loses_a_third(seed: int) -> None:
    world = World(seed)
    for name in ("a", "b"):
        world.add(config(name))
        read(world, name)
    for pipe in world.pipes.values():
        pipe.loss = 0.3
    world.run(STARTING_S + 10.0)
    rng = random.Random(seed)
    for turn in range(10):
        wanted = turn % 2 == 1
        read(world, "b", *(["map"] if wanted else []))
        world.run(LINGER_S + 2.0 + rng.random())
        world.send("a", "map", b"%d" % turn, "b")
        world.run(3.0)
    # The first message asks: the table is not known yet.
    assert received(world, "b", "map")[-5:] == [b"1", b"3", b"5", b"7", b"9"]
    assert len(received(world, "b", "map")) <= 6


def test_a_broadcast_goes_out_if_any_peer_wants_it() -> None:
    world = met(config("a"), config("b"), config("c"))
    world.send("a", "any", b"to ask")
    world.run(2.0)
    before = carried(world)
    world.send("a", "status", bytes(1000))
    world.run(0.05)
    assert carried(world) - before < 1000
    read(world, "c", "status")
    world.run(0.5)
    world.send("a", "status", b"wanted")
    world.run(0.5)
    assert received(world, "c", "status") == [b"wanted"]
    broadcasts = world.nodes["a"].selective.conditions().broadcasts
    assert (broadcasts.unread_messages, broadcasts.unread_bytes) >= (1, 1000)


def test_a_broadcast_asks_one_peer_at_a_time_and_none_if_one_is_known_to_read() -> None:
    names = [f"n{number}" for number in range(8)]
    world = World()
    for name in names:
        world.add(config(name))
        read(world, name, *(["status"] if name == "n3" else []))
    world.run(STARTING_S + 2.0)

    def known() -> list[str]:
        return [peer.name for peer in world.nodes["n0"].selective.conditions().peers if peer.known]

    for turn in range(12):
        world.send("n0", "status", b"%d" % turn)
        world.run(0.5)
        assert len(known()) <= turn + 1
    assert "n3" in known()
    asked = len(known())
    assert asked < len(names) - 1
    for turn in range(12):
        world.send("n0", "any", b"%d" % turn)
        world.run(0.5)
    assert len(known()) == len(names) - 1
    assert received(world, "n3", "status") == [b"%d" % turn for turn in range(12)]


def test_a_broadcast_before_the_table_arrives_is_not_lost() -> None:
    world = met()
    world.pipes["b", "a"].delay_s = 0.25
    read(world, "b", "map")
    world.send("a", "map", b"to all")
    world.run(2.0)
    assert received(world, "b", "map") == [b"to all"]


@pytest.mark.parametrize("destination", ["b", None])
def test_a_maximum_rate_lets_the_newest_message_of_each_interval_through(destination: str | None) -> None:
    world = met()
    read(world, "b", "status", rate_hz=1.0)
    world.run(0.5)
    sent: dict[bytes, float] = {}
    arrived: list[tuple[float, bytes]] = []
    for turn in range(100):
        payload = b"%d" % turn
        sent[payload] = world.now
        world.send("a", "status", payload, destination)
        world.run(0.1)
    world.run(2.0)
    for at, event in world.events["b"]:
        if isinstance(event, MessageReceived) and event.topic == "status":
            arrived.append((at, event.payload))
    assert 10 <= len(arrived) <= 12
    ages = [at - sent[payload] for at, payload in arrived]
    assert max(ages) < 0.15
    assert arrived[-1][1] == b"99"
    gaps = [later[0] - earlier[0] for earlier, later in pairwise(arrived)]
    assert min(gaps) > 0.9
    saved = world.nodes["a"].selective.conditions()
    counters = saved.broadcasts if destination is None else saved.peers[0].saved
    assert counters.thinned_messages == 100 - len(arrived)


def test_a_thinned_reliable_message_has_one_outcome() -> None:
    world = met()
    read(world, "b", "map", rate_hz=2.0)
    world.run(0.5)
    ids = []
    for _ in range(40):
        ids.append(world.send("a", "map", b"x", "b"))
        world.run(0.05)
    world.run(3.0)
    ended = [
        event.message_id
        for kind in (MessageDelivered, MessageExpired, MessagePeerLost)
        for event in outcomes(world, "a", kind, "map")
        if isinstance(event, MessageDelivered | MessageExpired | MessagePeerLost)
    ]
    assert sorted(ended) == ids
    assert len(outcomes(world, "a", MessageDelivered, "map")) == len(received(world, "b", "map")) <= 6


def test_a_second_reader_that_wants_all_lifts_the_first_ones_rate() -> None:
    world = met()
    read(world, "b", "status", rate_hz=0.5)
    world.run(0.5)
    world.send("a", "status", b"0", "b")
    world.send("a", "status", b"1", "b")
    world.run(0.2)
    assert received(world, "b", "status") == [b"0"]
    read(world, "b", "status")
    world.run(0.3)
    world.send("a", "status", b"2", "b")
    world.run(0.2)
    assert received(world, "b", "status") == [b"0", b"1", b"2"]


def test_a_message_older_than_wanted_is_dropped_before_it_is_sent() -> None:
    world = met()
    read(world, "b", "map", "bulk", max_age_s=2.0)
    world.run(0.5)
    world.pipes["a", "b"].rate_bits_per_s = 1e5
    for turn in range(20):
        world.send("a", "map", b"%02d" % turn * 6_000, "b")
    before = carried(world)
    world.run(30.0)
    late = outcomes(world, "a", MessageExpired, "map")
    assert {event.reason for event in late if isinstance(event, MessageExpired)} == {ExpiryReason.DEADLINE}
    assert len(late) > 10
    # Two seconds of the link, not the twenty that all of them take.
    assert carried(world) - before < 5 * 1e5 / 8
    (peer,) = world.nodes["a"].selective.conditions().peers
    assert peer.saved.aged_messages == len(late)


def test_a_topics_own_shorter_deadline_is_kept_and_not_counted_as_the_readers() -> None:
    topic = Topic("map", deadline_s=0.5)
    world = met(config("a", topic), config("b", topic))
    read(world, "b", "map", max_age_s=5.0)
    world.run(0.5)
    world.pipes["a", "b"].rate_bits_per_s = 1e4
    for _ in range(5):
        world.send("a", "map", bytes(3_000), "b")
    world.run(20.0)
    assert len(outcomes(world, "a", MessageExpired, "map")) >= 4
    assert world.nodes["a"].selective.conditions().peers[0].saved.aged_messages == 0


def test_closing_ends_what_is_withheld() -> None:
    world = met()
    world.send("a", "map", b"unread", "b")
    read(world, "b", "status", "map", rate_hz=0.1)
    world.run(0.5)
    world.send("a", "map", b"thinned", "b")
    world.nodes["a"].close(world.now)
    ended = [*outcomes(world, "a", MessageExpired, "map"), *outcomes(world, "a", MessageDelivered, "map")]
    assert len(ended) == 2
    assert world.nodes["a"].next_timer() is None


def test_a_message_on_disk_goes_to_the_peers_inbox_though_no_program_reads_there_now() -> None:
    topic = Topic("artifacts", outbox=Outbox.ALL, outbox_on_disk=True)
    disk = Disk()
    world = World()
    for name in ("a", "b"):
        changes: dict[str, object] = {"confirms": True}
        world.add(config(name, topic, **changes), store=disk if name == "a" else None)
        read(world, name)
    world.run(STARTING_S + 1.0)
    world.send("a", "artifacts", b"one", "b")
    world.run(5.0)
    (event,) = [event for event in world.events_of("b", MessageReceived) if isinstance(event, MessageReceived)]
    assert event.receipt is not None
    assert len(disk.kept) == 1
    world.nodes["b"].confirm(event.receipt)
    world.run(2.0)
    assert len(outcomes(world, "a", MessageDelivered, "artifacts")) == 1
    assert not disk.kept


@pytest.mark.parametrize("seed", range(6))
def test_every_reliable_message_ends_once_whatever_readers_do(seed: int) -> None:
    rng = random.Random(seed)
    names = ("a", "b", "c")
    world = met(*(config(name) for name in names), seed=seed)
    for pair in world.pipes:
        world.pipes[pair] = Pipe(rate_bits_per_s=1e6, loss=rng.choice((0.0, 0.1)))
    accepted: set[tuple[int, str]] = set()
    for _ in range(150):
        match rng.randrange(5):
            case 0:
                read(world, rng.choice(names), *rng.sample(("map", "m*", "status"), rng.randrange(3)))
            case 1:
                rate_hz, max_age_s = rng.choice((None, 1.0, 5.0)), rng.choice((None, 0.5, 3.0))
                read(world, rng.choice(names), "map", rate_hz=rate_hz, max_age_s=max_age_s)
            case _:
                source, peer = rng.sample(names, 2)
                made = world.send(source, "map", rng.randbytes(rng.choice((10, 3_000, 60_000))), peer)
                assert isinstance(made, int)
                if source == "a":
                    accepted.add((MessageId(made), peer))
        world.run(rng.choice((0.0, 0.02, 0.3, 1.0)))
    world.run(120.0)
    ended = [
        (event.message_id, event.peer)
        for kind in (MessageDelivered, MessageExpired, MessagePeerLost)
        for event in outcomes(world, "a", kind, "map")
        if isinstance(event, MessageDelivered | MessageExpired | MessagePeerLost)
    ]
    assert len(ended) == len(set(ended))
    assert set(ended) == accepted


def test_no_event_of_the_tables_themselves_is_seen() -> None:
    world = met()
    read(world, "b", "map")
    world.run(5.0)
    topics = {getattr(event, "topic", "") for name in world.nodes for _, event in world.events[name]}
    assert not [topic for topic in topics if topic.startswith("~mesh")]


def test_the_reserved_topics_are_not_among_the_listed_changes() -> None:
    world = met()
    changed: Settings = config("a", *TOPICS, Topic("new"))
    assert world.nodes["a"].apply(changed, world.now) == ["topic new: added"]
