"""Announcements that overtake each other, and items that their receiver has meanwhile or did not ask for."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from tests.udp_mesh.core.logs.team import LogTeam
from udp_mesh.core.events import MessageId
from udp_mesh.core.logs.item import ItemId, LogItem, LogKey, encode_item
from udp_mesh.core.logs.knowledge import MAX_KEPT_RANGES, LogState, PeerView, as_set, limit_ranges
from udp_mesh.core.logs.messages import MAX_ORDER, Have, HaveEntry, item_topic
from udp_mesh.core.logs.serving import MAX_SENDING, Serving
from udp_mesh.core.logs.store import ItemUse, MemoryLogStore
from udp_mesh.core.settings import Log, Topic
from udp_mesh.crypto.signing import SigningKey

KEY = LogKey("artifact", "spot", bytes(32))
OTHER = LogKey("artifact", "drone", bytes(32))


def hear(view: PeerView, order: int, *entries: HaveEntry, complete: bool = False) -> None:
    message = Have(entries, complete=complete, order=order)
    place = view.place(message)
    for entry in entries:
        view.set_held(entry, place)


@given(st.integers(1, 300), st.integers(1, MAX_ORDER // 2))
def test_an_older_announcement_does_not_replace_a_newer_one(newest: int, behind: int) -> None:
    view = PeerView()
    for number in range(1, newest + 1):
        hear(view, (number - 1) % MAX_ORDER + 1, HaveEntry(KEY, ((1, number),)))
    older = newest - behind
    if older > 0:
        hear(view, (older - 1) % MAX_ORDER + 1, HaveEntry(KEY, ((1, older),)), complete=True)
    assert view.held[KEY].ranges() == [(1, newest)]


def test_an_older_complete_announcement_removes_only_what_is_older_still() -> None:
    view = PeerView()
    hear(view, 1, HaveEntry(KEY, ((1, 1),)))
    hear(view, 3, HaveEntry(OTHER, ((1, 3),)))
    hear(view, 2, complete=True)
    assert view.held.keys() == {OTHER}
    hear(view, 1, HaveEntry(KEY, ((1, 1),)))
    assert view.held.keys() == {OTHER}


def test_announcements_that_are_not_counted_are_taken_in_the_order_they_come() -> None:
    view = PeerView()
    for last in (1, 5, 3):
        hear(view, 0, HaveEntry(KEY, ((1, last),)))
    assert view.held[KEY].ranges() == [(1, 3)]


def test_what_the_peer_has_from_others_is_not_sent() -> None:
    store, sent = MemoryLogStore(bytes(32)), list[bytes]()

    def send(topic: str, payload: bytes, destination: str | None, at: float) -> MessageId:
        sent.append(payload)
        return MessageId(len(sent))

    withdrawn = list[MessageId]()
    serving = Serving(store, send, lambda _, message, now: withdrawn.append(message), lambda call: call(0.0))
    for number in range(1, 9):
        store.put(ItemId(KEY, number), b"%d" % number, ItemUse.TAKEN, done=lambda _: None)
        serving.request("base", ItemId(KEY, number))
    serving.run(0.0, lambda *_: None)
    assert len(sent) == MAX_SENDING
    serving.peer_has("base", KEY, as_set([(2, 2), (5, 7)]), 0.0)
    assert withdrawn == [MessageId(2)]
    serving.ended(MessageId(1))
    serving.run(0.0, lambda *_: None)
    assert sent[MAX_SENDING:] == [b"8"]


def test_a_log_with_very_many_gaps_continues() -> None:
    state = LogState(KEY)
    for number in range(1, 2 * MAX_KEPT_RANGES + 100, 2):
        state.received.add(number)
        limit_ranges(state.received)
        assert state.add_reader("base", ((number, number),)) == ((number, number),)
    assert len(state.received) == MAX_KEPT_RANGES
    assert 2 * MAX_KEPT_RANGES + 99 in state.readers["base"]


def test_a_node_that_carries_nothing_stores_nothing_it_is_sent() -> None:
    team = LogTeam("spot", "husky", topics=[Topic("artifact", log=Log(readers=("base",), copies=0))])
    team.connect("spot", "husky")
    team.run(2)
    key = SigningKey(bytes(range(32)))
    data = encode_item(key, LogItem(ItemId(LogKey("artifact", "spot", key.public), 1), 0, "", b"pushed"))
    logs = team.nodes["husky"]._logs
    assert logs is not None
    assert logs.replicator.rejected_items == 0
    logs.replicator.on_item("spot", "artifact", data, team.now)
    assert logs.replicator.rejected_items == 1
    assert team.stores["husky"].items == {}
    assert item_topic("artifact") == "~mesh/log/artifact"
