"""Which items are requested from whom."""

from __future__ import annotations

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.udp_mesh.core.logs.team import ARTIFACT, LogTeam
from udp_mesh.core.logs.item import ItemId, LogKey
from udp_mesh.core.logs.knowledge import WEAK_PATIENCE_S, LogState, PeerView, as_set
from udp_mesh.core.logs.policy import Policy
from udp_mesh.core.logs.pulling import CUSTODY_DELAY_S, FULL_PAUSE_S, Pulling, in_at_least, rank
from udp_mesh.core.logs.retention import Shelf


@given(st.lists(st.lists(st.integers(1, 30), unique=True), max_size=6), st.integers(1, 4))
def test_numbers_that_enough_sets_contain(sets: list[list[int]], count: int) -> None:
    held = in_at_least(count, [as_set([(number, number) for number in numbers]) for numbers in sets])
    expected = {number for number in range(31) if sum(number in numbers for numbers in sets) >= count}
    assert {number for number in range(32) if number in held} == expected


@given(st.sets(st.text("abc", min_size=1), min_size=1, max_size=8), st.binary(min_size=32, max_size=32))
def test_each_node_has_a_rank_of_its_own(names: set[str], log_id: bytes) -> None:
    log = LogKey("artifact", "nobody", log_id)
    assert sorted(rank(name, log, names - {name}) for name in names) == list(range(len(names)))


def test_a_crowd_of_carriers_takes_few_copies() -> None:
    carriers = [f"robot{number}" for number in range(8)]
    team = LogTeam("base", "spot", *carriers, topics=[ARTIFACT])
    for number in range(5):
        team.publish("spot", b"%d" % number * 1000)
    team.meet("spot", *carriers, seconds=12)
    copies = [
        sum(item.number == number for name in carriers for item in team.stores[name].items) for number in range(1, 6)
    ]
    assert copies == [3, 3, 3, 3, 3]


class Carrier:
    """What a node that only carries plans; Spot, the source, and the base, a reader, are in reach."""

    def __init__(self) -> None:
        assert ARTIFACT.log is not None
        self.key = LogKey("artifact", "spot", bytes(32))
        self.state = LogState(self.key)
        self.peers = {"spot": PeerView(), "base": PeerView()}
        shelves = {"artifact": Shelf(ARTIFACT.log, lambda _: False, lambda _: False)}
        self.policy = Policy("husky", shelves, self.peers)
        self.policy.topics = {"artifact": ARTIFACT}
        self.pulling = Pulling()

    def requested(self, now: float, *, newest: int) -> list[tuple[str, tuple[tuple[int, int], ...]]]:
        """(peer, numbers) of the requests sent, if Spot has items up to `newest`."""
        self.peers["spot"].held[self.key] = as_set([(1, newest)])
        plan = self.pulling.plan({self.key: self.state}, self.peers, self.policy, now)
        return [(peer, ranges) for peer, request in plan for _, ranges in request.entries]

    def receive(self, number: int, now: float) -> None:
        self.pulling.requests.received(ItemId(self.key, number), now)
        self.state.received.add(number)


def test_a_carrier_leaves_every_item_to_a_reader_in_reach_not_only_the_first() -> None:
    carrier = Carrier()
    assert carrier.requested(0.0, newest=1) == []
    assert carrier.requested(CUSTODY_DELAY_S, newest=1) == [("spot", ((1, 1),))]
    carrier.receive(1, CUSTODY_DELAY_S)
    assert carrier.requested(CUSTODY_DELAY_S + 1, newest=1) == []
    assert carrier.requested(100.0, newest=2) == []
    assert carrier.requested(100.0 + CUSTODY_DELAY_S, newest=2) == [("spot", ((2, 2),))]


def test_a_request_that_the_transport_refused_is_planned_again_soon() -> None:
    carrier = Carrier()
    carrier.requested(0.0, newest=1)
    assert carrier.requested(CUSTODY_DELAY_S, newest=1) == [("spot", ((1, 1),))]
    carrier.pulling.not_sent("spot", CUSTODY_DELAY_S)
    assert carrier.requested(CUSTODY_DELAY_S, newest=1) == []
    later = CUSTODY_DELAY_S + FULL_PAUSE_S
    requests = [carrier.requested(later + step / 2, newest=1) for step in range(10)]
    assert requests.count([("spot", ((1, 1),))]) == 1


def test_a_carrier_leaves_a_weak_link_alone_until_it_is_better_or_stays_so() -> None:
    carrier = Carrier()
    del carrier.peers["base"]
    carrier.peers["spot"].weak_since = 10.0
    assert carrier.requested(10.0, newest=1) == []
    assert carrier.requested(10.0 + WEAK_PATIENCE_S - 1, newest=1) == []
    assert carrier.requested(10.0 + WEAK_PATIENCE_S, newest=1) == [("spot", ((1, 1),))]
    carrier.peers["spot"].weak_since = 100.0
    assert carrier.requested(100.0, newest=2) == []
    carrier.peers["spot"].weak_since = None
    assert carrier.requested(101.0, newest=2) == [("spot", ((2, 2),))]


def test_a_reader_requests_over_a_weak_link_at_once() -> None:
    reader = Carrier()
    reader.policy.name = "base"
    reader.peers["spot"].weak_since = 0.0
    assert reader.requested(0.0, newest=1) == [("spot", ((1, 1),))]


@pytest.mark.parametrize("one_arrives_of", [2, 4])
def test_the_link_is_weak_while_many_datagrams_to_all_are_lost(one_arrives_of: int) -> None:
    """With three lost in a row, too: those pauses are no absences."""
    team = LogTeam("base", "spot", "husky", topics=[ARTIFACT])
    turns = itertools.count(1)
    pipe = team.pipes["spot", "husky"]
    pipe.lost = lambda rng, now: next(turns) % one_arrives_of != 0
    team.connect("spot", "husky")
    team.run(15.0)
    team.publish("spot", b"x" * 1000)
    team.run(20.0)
    assert team.stores["husky"].items == {}
    pipe.lost = None
    team.run(12.0)
    assert len(team.stores["husky"].items) == 1
