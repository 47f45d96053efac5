"""What key holders can make a node do with its logs is bounded."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from udp_mesh.core.events import Event, LogItemHeld, MessageDelivered, MessageId, Rejected, RejectReason
from udp_mesh.core.logs.announcements import INTERVAL_S, Announcements
from udp_mesh.core.logs.item import ItemId, LogKey
from udp_mesh.core.logs.knowledge import MAX_LOST_NUMBERS, LogState, PeerView, as_set
from udp_mesh.core.logs.messages import HaveEntry
from udp_mesh.core.logs.outcomes import Outcomes
from udp_mesh.core.logs.retention import MAX_WRITING_BYTES, Shelf
from udp_mesh.core.logs.serving import MAX_QUEUED, RETRY_S, Serving
from udp_mesh.core.logs.store import ItemUse, MemoryLogStore
from udp_mesh.core.settings import Log

KEY = LogKey("artifact", "spot", bytes(32))


@given(st.sets(st.integers(1, 40)), st.integers(1, 40), st.integers(0, 15))
def test_gaps_and_removal_are_those_of_a_set(numbers: set[int], first: int, length: int) -> None:
    known = as_set([(number, number) for number in sorted(numbers)])
    missing = {number for begin, end in known.gaps(first, first + length) for number in range(begin, end + 1)}
    assert missing == set(range(first, first + length + 1)) - numbers
    known.remove(first)
    assert {number for number in range(60) if number in known} == numbers - {first}
    assert known.ranges() == as_set([(number, number) for number in sorted(numbers - {first})]).ranges()


def test_a_peer_queues_no_more_requests_than_the_limit() -> None:
    serving = Serving(MemoryLogStore(bytes(32)), lambda *_: MessageId(1), lambda *_: None, lambda _: None)
    answers = [serving.request("mallory", ItemId(KEY, number)) for number in range(1, 2 * MAX_QUEUED)]
    assert answers.count(True) == MAX_QUEUED
    assert len(serving._peers["mallory"].queue) == MAX_QUEUED


def test_an_item_waits_while_the_queue_of_the_transport_is_full() -> None:
    store = MemoryLogStore(bytes(32))
    item = ItemId(KEY, 1)
    store.put(item, b"data", ItemUse.TAKEN, done=lambda _: None)
    full, sent, now = True, list[bytes](), 0.0

    def send(topic: str, payload: bytes, destination: str | None, at: float) -> MessageId | Rejected:
        if full:
            return Rejected(RejectReason.QUEUE_FULL, "full")
        sent.append(payload)
        return MessageId(1)

    serving = Serving(store, send, lambda *_: None, lambda call: call(now))
    serving.request("base", item)
    serving.run(now, lambda *_: None)
    assert (sent, serving.next_at) == ([], RETRY_S)
    full, now = False, RETRY_S
    serving.run(now, lambda *_: None)
    assert sent == [b"data"]


def test_a_peer_that_keeps_asking_is_answered_a_few_times_a_second() -> None:
    sent = 0

    def send(*_: object) -> MessageId:
        nonlocal sent
        sent += 1
        return MessageId(1)

    announcements = Announcements(send, lambda log, peer: HaveEntry(log, ((1, 1),)), lambda *_: True, 0.0)
    view = PeerView()
    for step in range(100):
        view.needs_all = True
        announcements.run([KEY], {"mallory": view}, step / 100)
    assert sent <= 1 + 1 / INTERVAL_S
    assert announcements.next_at <= 1.0 + INTERVAL_S


def test_an_announcement_that_the_transport_refused_is_repeated() -> None:
    accepts = False

    def send(*_: object) -> MessageId | Rejected:
        return MessageId(1) if accepts else Rejected(RejectReason.QUEUE_FULL, "full")

    announcements = Announcements(send, lambda log, peer: HaveEntry(log, ((1, 1),)), lambda *_: True, 0.0)
    view = PeerView()
    announcements.run([KEY], {"base": view}, 0.0)
    assert (view.needs_all, view.asked) == (True, False)
    accepts = True
    announcements.run([KEY], {"base": view}, announcements.next_at)
    assert (view.needs_all, view.asked) == (False, True)


def test_nothing_more_is_requested_while_the_disk_is_far_behind() -> None:
    shelf = Shelf(Log(), lambda _: False, lambda _: False)
    assert shelf.room(10, wanted=True) == 10
    shelf.reserve(MAX_WRITING_BYTES)
    assert shelf.room(10, wanted=True) == 0
    shelf.release(MAX_WRITING_BYTES)
    assert shelf.room(10, wanted=True) == 10


def test_outcomes_of_many_items_are_reported_once_each() -> None:
    events: list[Event] = []
    outcomes = Outcomes(events.append)
    for number in range(1, 101):
        outcomes.add(ItemId(KEY, number), MessageId(1000 + number), 0.0)
    outcomes.report(KEY, {}, "husky", ((1, 1 << 40),), ("base",), 1.0)
    assert events == [LogItemHeld(MessageId(1000 + number), "husky", "artifact", number) for number in range(1, 101)]
    events.clear()
    for _ in range(2):
        outcomes.report(KEY, {"base": ((2, 3), (99, 1 << 40))}, "husky", ((1, 100),), ("base",), 2.0)
    assert events == [MessageDelivered(MessageId(1000 + number), "base", "artifact", 2.0) for number in (2, 3, 99, 100)]


def test_claims_far_beyond_its_own_numbers_do_not_use_them_up() -> None:
    state = LogState(KEY)
    state.note_used(HaveEntry(KEY, ((5, 1 << 40),)))
    assert state.used == 0
    state.note_used(HaveEntry(KEY, ((5, MAX_LOST_NUMBERS),)))
    assert state.used == MAX_LOST_NUMBERS
