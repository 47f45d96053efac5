"""The minimum window: large enough that losses are detected, on a channel of its own as well as beside others."""

import pytest

from udp_mesh.core.congestion.delay_based import MIN_CWND, DelayBasedController, Phase
from udp_mesh.core.congestion.rtt import RttEstimator


def window_after(loss: float, queue_share: float) -> float:
    """The window on a path whose round trips are always three times the minimum, so that the law keeps shrinking it."""
    rtt = RttEstimator()
    controller = DelayBasedController(rtt)
    controller.queue_share = queue_share
    rtt.sample(0.004, 0.0)
    for number in range(1, 40):
        now = 0.03 * number
        rtt.sample(0.012, now)
        controller.on_ack(1, number, number + 1, 4, 30.0, app_limited=False, ahead=3, lost=0, loss=loss, now=now)
    return controller.cwnd


@pytest.mark.parametrize(("loss", "packets"), [(0.0, 4.0), (0.05, 4.43), (0.25, 7.11), (0.9, 9.47)])
def test_the_minimum_window_grows_with_loss(loss: float, packets: float) -> None:
    assert window_after(loss, 1.0) == pytest.approx(packets, abs=0.01)


def test_the_minimum_window_stays_where_others_send_too() -> None:
    assert window_after(0.25, 0.9) == MIN_CWND


def phases(*, loss: float, round_trip_s: float, packets_per_s: float) -> tuple[set[Phase], bool]:
    """The phases in 30 s of a constant round trip behind a minimum of 8 ms, and whether the queue was explained all the
    time."""
    rtt = RttEstimator()
    controller = DelayBasedController(rtt)
    rtt.sample(0.008, 0.0)
    seen, is_explained = set(), True
    for number in range(1, 1000):
        now = 0.03 * number
        rtt.sample(round_trip_s, now)
        controller.on_ack(
            1, number, number + 1, 4, packets_per_s, app_limited=False, ahead=3, lost=0, loss=loss, now=now
        )
        if number % 100 == 0:
            # such as that of an urgent packet: it stays the minimum
            rtt.sample(0.008, now)
        if number > 100:
            seen.add(controller.phase)
        if number > 10:
            is_explained = is_explained and controller.is_queue_explained()
    return seen, is_explained


def test_the_smallest_window_is_not_drained_since_it_could_not_change() -> None:
    assert phases(loss=0.25, round_trip_s=0.014, packets_per_s=200.0) == ({Phase.CRUISE}, True)
    # without loss the minimum is less than what the law keeps
    drained, _ = phases(loss=0.0, round_trip_s=0.014, packets_per_s=200.0)
    assert Phase.DRAIN in drained or Phase.HOLD in drained


def test_the_smallest_window_explains_its_own_queue() -> None:
    # seven packets at 100 a second
    assert phases(loss=0.25, round_trip_s=0.060, packets_per_s=100.0)[1]
    # the same packets are gone in 7 ms
    assert not phases(loss=0.25, round_trip_s=0.060, packets_per_s=1000.0)[1]
