"""Which items are requested from whom."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from tests.udp_mesh.core.logs.team import ARTIFACT, LogTeam
from udp_mesh.core.logs.item import LogKey
from udp_mesh.core.logs.knowledge import as_set
from udp_mesh.core.logs.pulling import in_at_least, rank


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
