"""Conversion between loss and batman-adv's TQ."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from meshlab.quality import TQ_MAX, loss_of, tq_of
from meshlab.spec import LinkSpec, changed_link

shares = st.integers(0, 100).map(lambda hundredths: hundredths / 100)


@given(shares, shares)
def test_tq_never_increases_with_loss_in_either_direction(there: float, back: float) -> None:
    assert 0 <= tq_of(there, back) <= TQ_MAX
    assert tq_of(min(1.0, there + 0.01), back) <= tq_of(there, back)
    assert tq_of(there, min(1.0, back + 0.01)) <= tq_of(there, back)


@pytest.mark.parametrize(("there", "back"), [(1.0, 0.0), (0.0, 1.0), (1.0, 1.0)])
def test_total_loss_in_either_direction_gives_tq_zero(there: float, back: float) -> None:
    assert tq_of(there, back) == 0


@given(st.integers(0, TQ_MAX))
def test_converting_tq_to_loss_and_back_round_trips(tq: int) -> None:
    loss = loss_of(tq)
    assert abs(tq_of(loss, loss) - tq) <= 1


links = st.builds(
    LinkSpec,
    st.just("a"),
    st.just("b"),
    loss=shares,
    loss_back=st.none() | shares,
    signal_dbm=st.integers(-95, -30),
    signal_back_dbm=st.none() | st.integers(-95, -30),
)


@given(links)
def test_a_link_has_the_same_properties_from_either_end(link: LinkSpec) -> None:
    turned = link.seen_from("b")
    assert (turned.a, turned.b) == ("b", "a")
    for name in ("a", "b"):
        assert turned.loss_to(name) == link.loss_to(name)
        assert turned.signal_at(name) == link.signal_at(name)
        assert turned.tq_to(name) == link.tq_to(name)
    assert turned.seen_from("a").loss_to("b") == link.loss


@given(links, shares)
def test_a_one_way_loss_change_keeps_the_other_direction(link: LinkSpec, loss: float) -> None:
    changed = changed_link(link, {"loss_to_b": loss})
    assert (changed.loss_to("b"), changed.loss_to("a")) == (loss, link.loss_to("a"))


def test_a_new_loss_applies_in_both_directions_and_determines_tq() -> None:
    changed = changed_link(LinkSpec("a", "b", tq=100, loss=0.5, loss_back=0.1), {"loss": 0.0})
    assert (changed.loss_to("a"), changed.tq_to("a"), changed.tq_to("b")) == (0.0, TQ_MAX, TQ_MAX)
    assert changed_link(LinkSpec("a", "b"), {"loss": 0.1, "tq": 90}).tq_to("b") == 90
