"""The simulated channel behaves as its docstring says."""

from __future__ import annotations

import itertools
import random

from udp_mesh.sim.event_queue import SimEventQueue
from udp_mesh.sim.medium import FRAME_BYTES, IP_UDP_BYTES, Medium, RadioChannel, RadioFrame
from udp_mesh.sim.mobility import PathLoss, Wall, trajectory


class Line:
    """Stations in a row, each hearing only the next, with one frame loss for all links."""

    def __init__(self, names: str, loss: float = 0.0, **channel: float) -> None:
        self.event_queue = SimEventQueue()
        self.arrived: list[tuple[float, str, RadioFrame]] = []
        self.cut: set[frozenset[str]] = set()
        places = {name: index for index, name in enumerate(names)}

        def lost(a: str, b: str, now: float) -> float:
            near = abs(places[a] - places[b]) == 1 and frozenset((a, b)) not in self.cut
            return loss if near else 1.0

        def deliver(station: str, frame: RadioFrame) -> None:
            self.arrived.append((self.event_queue.now, station, frame))

        self.channel = RadioChannel(**channel)  # type: ignore[arg-type]
        self.medium = Medium(self.event_queue, self.channel, names, lost, deliver, random.Random(1))

    @property
    def stations(self) -> list[str]:
        return [station for _, station, _ in self.arrived]


def test_a_datagram_takes_one_transmission_per_hop() -> None:
    line = Line("abcd")
    line.medium.send("a", "d", b"x" * 100)
    line.event_queue.run_until(1.0)
    assert line.stations == ["d"]
    assert line.medium.hops("a", "d") == 3
    assert line.medium.counts.transmissions == 3


def test_airtime_is_bytes_over_rate_plus_overhead_per_transmission() -> None:
    line = Line("ab", rate=8e6, overhead_s=1e-3)
    line.medium.send("a", "b", bytes(1000))
    line.event_queue.run_until(1.0)
    assert line.medium.counts.airtime_s == (1000 + IP_UDP_BYTES + FRAME_BYTES) / 1e6 + 1e-3


def test_a_broadcast_reaches_all_once() -> None:
    line = Line("abcde")
    line.medium.send("c", None, b"x")
    line.event_queue.run_until(1.0)
    assert sorted(line.stations) == ["a", "b", "d", "e"]


def test_the_channel_is_shared_so_two_senders_get_half_each() -> None:
    line = Line("ab", rate=1e6, queue_frames=10_000)
    for _ in range(500):
        line.medium.send("a", "b", bytes(1000))
        line.medium.send("b", "a", bytes(1000))
    line.event_queue.run_until(4.0)
    assert line.medium.counts.airtime_s <= 4.02
    to_a, to_b = line.stations.count("a"), line.stations.count("b")
    assert abs(to_a - to_b) < 0.2 * (to_a + to_b)


def test_retries_hide_loss_at_the_price_of_airtime() -> None:
    clean, lossy = Line("ab", queue_frames=2000), Line("ab", loss=0.5, queue_frames=2000, attempts=20)
    for line in (clean, lossy):
        for _ in range(1000):
            line.medium.send("a", "b", bytes(100))
        line.event_queue.run_until(10.0)
        assert len(line.arrived) == 1000
    assert 1.8 < lossy.medium.counts.airtime_s / clean.medium.counts.airtime_s < 2.2


def test_a_full_queue_drops_and_counts() -> None:
    line = Line("ab", queue_frames=10)
    for _ in range(100):
        line.medium.send("a", "b", bytes(1000))
    line.event_queue.run_until(1.0)
    assert len(line.arrived) + line.medium.counts.queue_drops == 100
    assert line.medium.counts.queue_drops >= 89


def test_routes_are_recomputed_only_after_the_routing_interval() -> None:
    line = Line("abc", route_s=1.0)
    line.medium.send("a", "c", b"x")
    line.event_queue.run_until(0.5)
    line.cut.add(frozenset("bc"))
    line.medium.send("a", "c", b"x")
    line.event_queue.run_until(0.9)
    assert line.medium.counts.losses == 1
    line.event_queue.run_until(1.5)
    line.medium.send("a", "c", b"x")
    line.event_queue.run_until(2.0)
    assert line.medium.counts.unroutable == 1
    assert line.stations == ["c"]


def test_a_radio_that_is_off_neither_sends_nor_receives_nor_forwards() -> None:
    line = Line("abc")
    line.medium.set_on("b", False)
    line.medium.send("a", "c", b"x")
    line.medium.send("b", "a", b"x")
    line.event_queue.run_until(1.0)
    assert line.arrived == []


def test_the_same_seed_gives_the_same_run() -> None:
    def run() -> list[tuple[float, str, int]]:
        line = Line("abcd", loss=0.3)
        for number in range(50):
            line.medium.send("ad"[number % 2], "da"[number % 2], bytes(500))
        line.event_queue.run_until(5.0)
        return [(at, station, frame.number) for at, station, frame in line.arrived]

    assert run() == run()


def test_loss_grows_with_distance_and_walls_block_everything() -> None:
    air = PathLoss(good_m=50, range_m=100, least_loss=0.1, walls=(Wall((0, 10), (100, 10)),))
    assert air.loss((0, 0), (20, 0)) == 0.1
    assert air.loss((0, 0), (75, 0)) == 0.55
    assert air.loss((0, 0), (100, 0)) == 1.0
    assert air.loss((10, 0), (10, 20)) == 1.0


def test_a_trajectory_consists_of_straight_lines() -> None:
    walked = trajectory([(10, (0, 0)), (20, (100, 50))])
    assert walked.at(0) == (0, 0)
    assert walked.at(15) == (50, 25)
    assert walked.at(99) == (100, 50)


def test_an_urgent_frame_overtakes_other_frames_of_its_station() -> None:
    line = Line("ab", rate=1e6)
    for _ in range(20):
        line.medium.send("a", "b", bytes(1000))
    line.medium.send("a", "b", b"stop", urgent=True)
    line.event_queue.run_until(1.0)
    places = [frame.urgent for _, _, frame in line.arrived]
    assert len(places) == 21
    assert places.index(True) <= 1


def test_urgent_frames_wait_less_for_the_channel_than_others() -> None:
    line = Line("ab", rate=1e6, queue_frames=10_000)
    for _ in range(500):
        line.medium.send("a", "b", bytes(1000), urgent=True)
        line.medium.send("b", "a", bytes(1000))
    line.event_queue.run_until(4.0)
    assert line.stations.count("b") > 1.5 * line.stations.count("a")


def test_a_radio_without_access_categories_keeps_the_order() -> None:
    line = Line("ab", rate=1e6, access_categories=False)
    for number in range(20):
        line.medium.send("a", "b", bytes(1000), urgent=number % 2 == 1)
    line.event_queue.run_until(1.0)
    assert [frame.number for _, _, frame in line.arrived] == list(range(1, 21))


def test_each_stations_airtime_is_counted() -> None:
    line = Line("ab")
    line.medium.send("a", "b", bytes(1000))
    line.medium.send("b", "a", bytes(10))
    line.event_queue.run_until(1.0)
    counts = line.medium.counts
    assert counts.airtime_s_of["a"] > counts.airtime_s_of["b"] > 0
    assert sum(counts.airtime_s_of.values()) == counts.airtime_s


def test_backoff_resumes_instead_of_restarting_after_a_busy_channel() -> None:
    line = Line("ab", rate=1e6, queue_frames=10_000)
    for _ in range(400):
        line.medium.send("a", "b", bytes(1000))
        line.medium.send("b", "a", bytes(1000))
    line.event_queue.run_until(3.0)
    runs = [len(list(group)) for _, group in itertools.groupby(line.stations)]
    # a back-off that restarted each time would let one of two stations send eight times in a row now and then
    assert max(runs) <= 6
