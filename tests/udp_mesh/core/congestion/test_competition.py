"""When to compete with foreign flows: a queue that drains of ours do not empty, and that is not a longer route."""

import pytest

from udp_mesh.core.congestion.competition import DECREASE, INCREASE, ROUTE_HOLDS, Competition


def alone(rtt_s: float = 0.02) -> Competition:
    competition = Competition()
    for number in range(10):
        competition.on_round(rtt_s, loss=0.0, now=number * rtt_s)
    return competition


def drain(competition: Competition, *rtts_s: float, others_send: bool = False) -> None:
    for number, rtt_s in enumerate(rtts_s):
        competition.on_drained(rtt_s, others_send=others_send, now=1.0 + number)


def test_varying_long_round_trips_enable_competition() -> None:
    competition = alone()
    drain(competition, 0.08)
    assert competition.is_suspected
    assert not competition.is_on
    drain(competition, 0.10)
    assert competition.is_on


def test_a_queue_that_shrinks_without_our_drain_enables_competition() -> None:
    competition = alone()
    drain(competition, 0.10)
    competition.on_round(0.07, loss=0.0, now=2.0)
    assert competition.is_on


def test_a_longer_route_does_not_enable_competition() -> None:
    competition = alone()
    drain(competition, *[0.15] * ROUTE_HOLDS)
    assert not competition.is_on
    assert not competition.is_suspected
    assert competition.base_rtt() == 0.15


def test_the_first_empty_queue_ends_competition() -> None:
    competition = alone()
    drain(competition, 0.08, 0.10)
    drain(competition, 0.022)
    assert not competition.is_on
    assert not competition.is_suspected


def test_nodes_that_report_their_send_rate_are_not_foreign_flows() -> None:
    competition = alone()
    drain(competition, 0.08, 0.10, others_send=True)
    assert not competition.is_on


def test_the_window_grows_until_loss_occurs_at_a_long_queue() -> None:
    competition = alone()
    drain(competition, 0.08, 0.10)
    assert competition.window(20.0, 0.1) == 20.0 + INCREASE
    competition.on_lost(2)
    assert competition.window(20.0, 0.1) == pytest.approx(20.0 * DECREASE)
    assert competition.window(20.0, 0.1) == 20.0 + INCREASE


def test_radio_losses_do_not_shrink_the_window() -> None:
    competition = Competition()
    for number in range(500):
        competition.on_round(0.02, loss=0.05, now=number * 0.02)
    drain(competition, 0.08, 0.10)
    competition.on_lost(2)
    assert competition.window(40.0, 0.1) == 40.0 + INCREASE
    competition.on_lost(2)
    assert competition.window(20.0, 0.03) == 20.0 + INCREASE
    competition.on_lost(9)
    assert competition.window(40.0, 0.1) < 40.0
