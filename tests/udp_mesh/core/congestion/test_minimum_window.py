"""The minimum window: large enough that losses are detected, on a channel of its own as well as beside others."""

import pytest

from udp_mesh.core.congestion.delay_based import MIN_CWND, DelayBasedController
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
