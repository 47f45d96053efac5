"""Reconnect time -> intervals -> what they cost."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from meshctl.model import Batman
from meshctl.resolve import MEASURED_HEAL_S, UnreachableTarget, batman_intervals, heal_s, originator_airtime
from meshctl.resolve.airtime import frame_airtime_us
from tests.meshctl.render import fleets


@pytest.mark.parametrize(
    ("reconnect_s", "interval_ms"),
    [(60, 1000), (5.0, 1000), (4.9, 500), (2.9, 500), (2.8, 250), (1.35, 250), (1.3, 100), (0.6, 100)],
)
def test_the_longest_interval_that_heals_in_time_is_chosen(reconnect_s: float, interval_ms: int) -> None:
    assert batman_intervals(fleets.mesh(reconnect_s=reconnect_s)).orig_interval_ms == interval_ms


def test_an_unreachable_reconnect_time_is_rejected() -> None:
    with pytest.raises(UnreachableTarget, match=r"at least 0\.6 s, found 0\.5 s"):
        batman_intervals(fleets.mesh(reconnect_s=0.5))


def test_an_explicit_interval_is_used_as_given() -> None:
    mesh = fleets.mesh(reconnect_s=0.1, batman=Batman(orig_interval_ms=3000, elp_interval_ms=77))
    intervals = batman_intervals(mesh)
    assert (intervals.orig_interval_ms, intervals.elp_interval_ms) == (3000, 77)


def test_links_are_measured_at_least_twice_per_originator_interval() -> None:
    for reconnect_s in MEASURED_HEAL_S.values():
        intervals = batman_intervals(fleets.mesh(reconnect_s=reconnect_s))
        assert 2 * intervals.elp_interval_ms <= intervals.orig_interval_ms
    assert batman_intervals(replace(fleets.mesh(), reconnect_s=60)).elp_interval_ms == 500


@given(st.integers(1, 20_000), st.integers(1, 20_000))
def test_a_longer_interval_never_heals_sooner(one: int, other: int) -> None:
    short, long = sorted((one, other))
    assert heal_s(short) <= heal_s(long)


@pytest.mark.parametrize(("interval_ms", "seconds"), MEASURED_HEAL_S.items())
def test_measured_intervals_return_the_measured_healing_time(interval_ms: int, seconds: float) -> None:
    assert heal_s(interval_ms) == seconds


def test_frame_airtime_matches_a_manual_calculation() -> None:
    # 52 + 36 bytes at 12 Mbit/s: (88 x 8 + 22) bits / 48 bits a symbol = 16 symbols of 4 us
    assert frame_airtime_us(52, 12_000) == pytest.approx(95.5 + 26 + 64)
    # at 1 Mbit/s a bit takes a microsecond
    assert frame_airtime_us(52, 1000) == pytest.approx(360 + 192 + 704)


def test_a_lone_node_sends_only_its_own_originator_message() -> None:
    assert originator_airtime(1, 1000, 12_000) == pytest.approx(frame_airtime_us(52, 12_000) / 1e6)
    assert originator_airtime(0, 1000, 12_000) == 0


def test_without_aggregation_every_node_repeats_every_message() -> None:
    expected = 10 * 10 * frame_airtime_us(52, 12_000) / 1e6
    assert originator_airtime(10, 1000, 12_000, is_aggregated=False) == pytest.approx(expected)


@given(st.integers(1, 200), st.sampled_from([100, 250, 500, 1000]), st.sampled_from([1000, 6000, 12_000, 24_000]))
def test_more_nodes_shorter_intervals_and_slower_rates_cost_more_airtime(
    nodes: int, interval_ms: int, rate: int
) -> None:
    cost = originator_airtime(nodes, interval_ms, rate)
    assert originator_airtime(nodes + 1, interval_ms, rate) > cost
    assert originator_airtime(nodes, interval_ms * 2, rate) < cost
    assert originator_airtime(nodes, interval_ms, rate * 2) < cost
    assert cost <= originator_airtime(nodes, interval_ms, rate, is_aggregated=False) * 1.000001


@pytest.mark.parametrize(("interval_ms", "rate"), [(0, 12_000), (1000, 0), (-1, 1)])
def test_a_non_positive_interval_or_rate_is_rejected(interval_ms: int, rate: int) -> None:
    with pytest.raises(ValueError, match="positive"):
        originator_airtime(2, interval_ms, rate)
