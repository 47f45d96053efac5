"""Foreign flows behave as their specifications say: CUBIC fills the queue, BBR holds about one round trip's worth."""

import random
from statistics import fmean

import pytest

from udp_mesh.sim.event_queue import SimEventQueue
from udp_mesh.sim.links.bbr import Bbr
from udp_mesh.sim.links.cubic import BETA, Cubic
from udp_mesh.sim.links.path import Bottleneck, Link
from udp_mesh.sim.links.tcp import PAYLOAD_BYTES, SEGMENT_BYTES, TcpController, TcpFlow
from udp_mesh.sim.links.traces import constant

RATE = 10e6
DELAY_S = 0.02
QUEUE_PACKETS = 100
BDP = RATE * 2 * DELAY_S / 8 / SEGMENT_BYTES


class Alone:
    """One flow on its own link."""

    def __init__(self, *controllers: TcpController, loss: float = 0.0) -> None:
        self.queue = SimEventQueue()
        link = Link(constant(RATE), constant(DELAY_S), queue_packets=QUEUE_PACKETS, loss=loss)
        self.forward = Bottleneck(self.queue, link, random.Random(1))
        backward = Bottleneck(self.queue, link, random.Random(2))
        self.flows = [TcpFlow(self.queue, one, self.forward, backward) for one in controllers]

    def run(self, warm_up_s: float, seconds: float) -> tuple[list[float], list[int]]:
        """Shares of the link, and samples of the queue."""
        self.queue.run_until(warm_up_s)
        before = [flow.received_bytes for flow in self.flows]
        queued = []
        for _ in range(int(seconds * 100)):
            self.queue.run_until(self.queue.now + 0.01)
            queued.append(self.forward.queued)
        most = RATE * seconds / 8 * PAYLOAD_BYTES / SEGMENT_BYTES
        received = [flow.received_bytes - old for flow, old in zip(self.flows, before, strict=True)]
        return [one / most for one in received], queued


def test_cubic_alone_fills_the_link_and_the_queue() -> None:
    (share,), queued = Alone(Cubic()).run(10.0, 30.0)
    assert share > 0.99
    assert max(queued) == QUEUE_PACKETS
    assert fmean(queued) > 0.6 * QUEUE_PACKETS


def test_cubic_multiplies_its_window_by_beta_after_a_loss() -> None:
    controller = Cubic()
    controller.cwnd = 100.0
    controller.on_loss(1.0, 100)
    assert controller.cwnd == pytest.approx(100 * BETA)


def test_random_loss_reduces_cubic_throughput() -> None:
    (share,), _ = Alone(Cubic(), loss=0.02).run(10.0, 20.0)
    assert share < 0.4


def test_bbr_alone_fills_the_link_with_a_short_queue() -> None:
    (share,), queued = Alone(Bbr(random.Random(1))).run(5.0, 30.0)
    assert share > 0.94
    assert fmean(queued) < BDP
    assert max(queued) <= 1.5 * BDP


def test_bbr_holds_about_one_round_trip_in_flight() -> None:
    alone = Alone(Bbr(random.Random(1)))
    alone.queue.run_until(5.0)
    in_flight = []
    for _ in range(2000):
        alone.queue.run_until(alone.queue.now + 0.01)
        in_flight.append(alone.flows[0].in_flight)
    assert 0.9 * BDP < fmean(in_flight) < 1.6 * BDP
    # Every ten seconds it lets the queue run empty to see the round trip.
    assert min(in_flight) <= 4


def test_random_loss_does_not_reduce_bbr_throughput() -> None:
    (share,), _ = Alone(Bbr(random.Random(1)), loss=0.02).run(5.0, 20.0)
    assert share > 0.9


def test_two_cubic_flows_share_the_link_fairly() -> None:
    shares, _ = Alone(Cubic(), Cubic()).run(20.0, 60.0)
    assert sum(shares) > 0.99
    assert min(shares) > 0.35


def test_bbr_beside_cubic_on_a_deep_queue_gets_less_than_half() -> None:
    (bbr, cubic), _ = Alone(Bbr(random.Random(1)), Cubic()).run(10.0, 60.0)
    assert 0.1 < bbr < 0.5
    assert cubic > bbr
