"""Long absences: an outbox costs the same per message however much it holds, is emptied in steps, and stays on disk."""

import sys
from types import FrameType

import pytest

from tests.udp_mesh.core.pair import World, settings
from tests.udp_mesh.disk import Disk
from udp_mesh.core.events import (
    ExpiryReason,
    MessageDelivered,
    MessageExpired,
    MessageReceived,
    PeerOffline,
    PeerOnline,
)
from udp_mesh.core.interfaces import Store, StoredMessage
from udp_mesh.core.publish import RELEASE_BATCH
from udp_mesh.core.settings import Outbox, Topic

LOG = Topic("log", priority=8, outbox=Outbox.ALL)
STATUS = Topic("status", priority=0, outbox=Outbox.ALL)


def met(*topics: Topic, store: Store | None = None) -> World:
    world = World(seed=1)
    world.add(settings("a", *topics), store=store)
    world.add(settings("b", *topics))
    assert world.run(5.0, until=lambda: bool(world.events_of("a", PeerOnline) and world.events_of("b", PeerOnline)))
    return world


def reach(world: World, up: bool) -> None:
    for pipe in world.pipes.values():
        pipe.up = up


def away(*topics: Topic) -> World:
    """A world in which b is offline for a."""
    world = met(*topics)
    reach(world, up=False)
    assert world.run(30.0, until=lambda: bool(world.events_of("a", PeerOffline)))
    return world


def send(world: World, topic: str, numbers: range) -> None:
    """Without advancing virtual time or running other nodes in between."""
    for number in numbers:
        world.nodes["a"].send(topic, b"%d" % number, destination="b", now=world.now)


def arrived(world: World, topic: str) -> list[int]:
    events = [event for event in world.events_of("b", MessageReceived) if isinstance(event, MessageReceived)]
    return [int(event.payload) for event in events if event.topic == topic]


def held(world: World) -> int:
    return world.nodes["a"].conditions(world.now).peers[0].outbox_messages


class Calls:
    """Counts function calls, which do not depend on the machine's speed."""

    def __enter__(self) -> "Calls":
        self.count = 0
        sys.setprofile(self._called)
        return self

    def _called(self, _frame: FrameType, what: str, _argument: object) -> None:
        self.count += what in ("call", "c_call")

    def __exit__(self, *_: object) -> None:
        sys.setprofile(None)


@pytest.mark.parametrize(
    "topic", [LOG, Topic("log", outbox=Outbox.LAST), Topic("log", outbox=Outbox.ALL, deadline_s=900.0)]
)
def test_the_cost_of_a_send_does_not_depend_on_outbox_size(topic: Topic) -> None:
    world = away(topic)
    send(world, "log", range(300))
    with Calls() as few:
        send(world, "log", range(300, 400))
    send(world, "log", range(400, 3000))
    with Calls() as many:
        send(world, "log", range(3000, 3100))
    assert many.count < 1.2 * few.count


def test_returning_in_flight_messages_to_an_outbox_takes_linear_time() -> None:
    counts = []
    for messages in (500, 2000):
        world = met(LOG)
        reach(world, up=False)
        send(world, "log", range(messages))
        with Calls() as calls:
            assert world.run(30.0, until=lambda: bool(world.events_of("a", PeerOffline)))  # noqa: B023
        assert held(world) == messages
        counts.append(calls.count)
    assert counts[1] < 8 * counts[0]


def test_a_large_outbox_is_drained_in_batches_in_order_without_duplicates() -> None:
    world = away(LOG)
    send(world, "log", range(3 * RELEASE_BATCH))
    reach(world, up=True)
    assert world.run(20.0, until=lambda: held(world) < 3 * RELEASE_BATCH)
    assert held(world) == 2 * RELEASE_BATCH
    # Messages published meanwhile come later.
    send(world, "log", range(3 * RELEASE_BATCH, 3 * RELEASE_BATCH + 50))
    world.run(10.0)
    assert arrived(world, "log") == list(range(3 * RELEASE_BATCH + 50))
    assert len(world.events_of("a", MessageDelivered)) == 3 * RELEASE_BATCH + 50
    assert held(world) == 0


def test_urgent_messages_do_not_wait_for_the_outbox() -> None:
    world = away(LOG, STATUS)
    send(world, "log", range(3 * RELEASE_BATCH))
    send(world, "status", range(2))
    reach(world, up=True)
    assert world.run(20.0, until=lambda: held(world) < 3 * RELEASE_BATCH + 2)
    send(world, "status", range(2, 3))
    assert world.run(20.0, until=lambda: len(arrived(world, "status")) == 3)
    assert len(arrived(world, "log")) < RELEASE_BATCH


def test_messages_returned_to_the_outbox_are_sent_before_those_still_held() -> None:
    world = away(LOG)
    send(world, "log", range(3 * RELEASE_BATCH))
    reach(world, up=True)
    assert world.run(20.0, until=lambda: held(world) < 3 * RELEASE_BATCH)
    reach(world, up=False)
    world.run(20.0)
    assert held(world) + len(world.events_of("a", MessageDelivered)) == 3 * RELEASE_BATCH
    reach(world, up=True)
    world.run(20.0)
    assert sorted(arrived(world, "log")) == list(range(3 * RELEASE_BATCH))
    assert arrived(world, "log")[-RELEASE_BATCH:] == list(range(2 * RELEASE_BATCH, 3 * RELEASE_BATCH))


@pytest.mark.parametrize("deadline_s", [None, 3600.0])
@pytest.mark.parametrize("keep_last", [None, 1])
def test_finished_messages_are_freed_before_their_deadline(deadline_s: float | None, keep_last: int | None) -> None:
    world = met(Topic("t", deadline_s=deadline_s, keep_last=keep_last), LOG)
    payloads = [b"%d" % number * 10 for number in range(600)]
    for payload in payloads:
        world.send("a", "t", payload, "b")
        world.run(0.03)
    # The list, the loop, the argument.
    assert sum(sys.getrefcount(payload) > 3 for payload in payloads) < 150


def test_messages_dropped_from_an_outbox_are_freed_before_their_deadline() -> None:
    world = away(Topic("t", outbox=Outbox.LAST, deadline_s=3600.0))
    payloads = [b"%d" % number * 10 for number in range(600)]
    for payload in payloads:
        world.send("a", "t", payload, "b")
    assert sum(sys.getrefcount(payload) > 3 for payload in payloads) < 150


@pytest.mark.parametrize("size_bytes", [100, 300_000])
@pytest.mark.parametrize("compression", [False, True])
def test_a_message_is_on_disk_from_its_acceptance_to_its_outcome(size_bytes: int, compression: bool) -> None:
    topic = Topic("t", outbox=Outbox.ALL, outbox_on_disk=True, compression=compression)
    disk = Disk()
    world = met(topic, store=disk)
    payload = world.rng.randbytes(size_bytes // 2) + bytes(size_bytes - size_bytes // 2)
    world.nodes["a"].send("t", payload, destination="b", now=world.now)
    assert [kept.payload for kept in disk.kept.values()] == [payload]
    # The robot loses power while the message is being sent.
    world.run(0.005)
    world.add(settings("a", topic), store=disk)
    assert world.run(20.0, until=lambda: bool(world.events_of("a", MessageDelivered)))
    assert payload in [
        event.payload for event in world.events_of("b", MessageReceived) if isinstance(event, MessageReceived)
    ]
    assert disk.kept == {}


class FullDisk(Disk):
    def put(self, message: StoredMessage) -> bool:
        return False


class FailingDisk(Disk):
    """Accepts everything and later fails to write it."""

    def put(self, message: StoredMessage) -> bool:
        return True


@pytest.mark.parametrize("online", [True, False])
@pytest.mark.parametrize("disk", [FullDisk, FailingDisk])
def test_a_message_not_written_to_disk_expires_when_the_node_closes(online: bool, disk: type[Disk]) -> None:
    topic = Topic("t", outbox=Outbox.ALL, outbox_on_disk=True)
    world = met(topic, store=disk())
    reach(world, up=False)
    if not online:
        assert world.run(30.0, until=lambda: bool(world.events_of("a", PeerOffline)))
    world.send("a", "t", b"only in memory", "b")
    world.nodes["a"].close(world.now)
    ends = [event for event in world.events_of("a", MessageExpired) if isinstance(event, MessageExpired)]
    assert [end.reason for end in ends] == [ExpiryReason.CLOSED]
