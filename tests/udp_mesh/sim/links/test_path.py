"""Paths: serialization, queue, loss, stalls in order, reordering, MTU, and half-duplex hops."""

import random
from functools import partial
from itertools import pairwise

import pytest

from udp_mesh.sim.event_queue import SimEventQueue
from udp_mesh.sim.links.path import Bottleneck, HalfDuplexChain, Link
from udp_mesh.sim.links.traces import Steps, constant


def carried(link: Link, packets: int, packet_bytes: int = 1250, every_s: float = 0.0) -> list[tuple[int, float]]:
    """(number, arrival) of packets in the order in which they arrive."""
    queue = SimEventQueue()
    path = Bottleneck(queue, link, random.Random(1))
    arrived: list[tuple[int, float]] = []
    for number in range(packets):
        deliver = partial(lambda number: arrived.append((number, queue.now)), number)
        queue.at(number * every_s, partial(path.send, packet_bytes, deliver))
    queue.run_until(1000.0)
    return arrived


def test_packets_arrive_at_the_link_rate_after_the_delay() -> None:
    arrived = carried(Link(constant(10e6), constant(0.02)), 3)
    assert [at for _, at in arrived] == pytest.approx([0.021, 0.022, 0.023])


def test_a_full_queue_drops() -> None:
    assert len(carried(Link(queue_packets=5), 20)) == 5


def test_a_link_without_rate_holds_its_queue_until_it_returns() -> None:
    arrived = carried(Link(Steps((0.0, 0.5), (0.0, 10e6)), constant(0.0)), 2)
    assert [at for _, at in arrived] == pytest.approx([0.501, 0.502])


def test_packets_are_lost_at_the_configured_rate() -> None:
    assert len(carried(Link(loss=0.2), 5000, every_s=0.01)) == pytest.approx(4000, rel=0.03)


def test_a_stall_delays_everything_behind_it_and_keeps_the_order() -> None:
    link = Link(constant(10e6), constant(0.01), stalls_per_s=5.0)
    arrived = carried(link, 2000, every_s=0.002)
    assert [number for number, _ in arrived] == list(range(2000))
    late = [at - number * 0.002 for number, at in arrived]
    assert max(late) > 0.02
    bursts = sum(later - earlier < 1e-9 for (_, earlier), (_, later) in pairwise(arrived))
    assert bursts > 20


def test_reordering_changes_the_order_and_loses_nothing() -> None:
    numbers = [number for number, _ in carried(Link(reorder_share=0.05), 500, every_s=0.002)]
    assert sorted(numbers) == list(range(500))
    assert numbers != sorted(numbers)


def test_packets_larger_than_the_mtu_are_dropped() -> None:
    link = Link(mtu=Steps((0.0, 1.0), (1500, 1300)))
    assert len(carried(link, 20, packet_bytes=1400, every_s=0.1)) == 10


def chain(hop_loss: float) -> tuple[SimEventQueue, HalfDuplexChain]:
    queue = SimEventQueue()
    return queue, HalfDuplexChain(
        queue, random.Random(1), hops=3, rate=10e6, overhead_s=0.0005, hop_loss=hop_loss, queue_packets=4000
    )


def test_hops_share_one_half_duplex_channel() -> None:
    queue, line = chain(0.0)
    arrived: list[float] = []
    for _ in range(100):
        line.forward().send(1250, lambda: arrived.append(queue.now))
    queue.run_until(10.0)
    assert len(arrived) == 100
    assert arrived[-1] == pytest.approx(300 * 0.0015)


def test_hops_lose_frames_in_both_directions() -> None:
    queue, line = chain(0.1)
    arrived = {"there": 0, "back": 0}
    for name, end in (("there", line.forward()), ("back", line.backward())):
        for _ in range(2000):
            end.send(500, partial(lambda name: arrived.update({name: arrived[name] + 1}), name))
    queue.run_until(100.0)
    assert arrived["there"] == pytest.approx(2000 * 0.729, rel=0.05)
    assert arrived["back"] == pytest.approx(2000 * 0.729, rel=0.05)
