"""Whether a link gets better or worse: the slope, its hysteresis, and links that change."""

import math
import random

import pytest

from tests.udp_mesh.core.pair import World, settings
from udp_mesh.core.link_trend import (
    ENTER_CHANGE,
    LEAVE_CHANGE,
    WINDOW_S,
    Direction,
    LinkTrend,
    Measure,
    Trend,
    median_slope,
    next_direction,
)
from udp_mesh.core.settings import Topic


def fed(values: list[float | None], *, round_trip_s: float | None = None) -> Trend | None:
    """The trend after a capacity per second."""
    link = LinkTrend()
    for second, value in enumerate(values):
        link.feed(value, round_trip_s, second + 1, float(second))
    return link.trend


def test_the_slope_is_that_of_most_pairs() -> None:
    line = [(float(at), 3.0 - 0.5 * at) for at in range(20)]
    assert median_slope(line) == pytest.approx(-0.5)
    for outlier in (0, 1, 2, 10):
        line[outlier] = (line[outlier][0], 1000.0)
    assert median_slope(line) == pytest.approx(-0.5, rel=0.3)
    assert median_slope([(1.0, 2.0)]) is None
    assert median_slope([(1.0, 2.0), (1.0, 3.0)]) is None


@pytest.mark.parametrize("sign", [1, -1])
def test_a_direction_lasts_until_the_change_is_half_of_what_began_it(sign: int) -> None:
    to, opposite = (Direction.IMPROVING, Direction.WORSENING)[::sign]
    assert next_direction(Direction.STEADY, sign * ENTER_CHANGE) is to
    assert next_direction(Direction.STEADY, sign * ENTER_CHANGE * 0.99) is Direction.STEADY
    assert next_direction(to, sign * LEAVE_CHANGE) is to
    assert next_direction(to, sign * LEAVE_CHANGE * 0.99) is Direction.STEADY
    assert next_direction(opposite, sign * LEAVE_CHANGE) is Direction.STEADY
    assert next_direction(opposite, sign * ENTER_CHANGE) is to


@pytest.mark.parametrize("change_per_s", [-0.03, 0.03])
def test_the_change_of_a_noisy_capacity_is_found(change_per_s: float) -> None:
    rng = random.Random(3)
    trend = fed([1e6 * math.exp(change_per_s * second + rng.gauss(0, 0.1)) for second in range(60)])
    assert trend is not None
    assert trend.direction is (Direction.IMPROVING if change_per_s > 0 else Direction.WORSENING)
    assert trend.measure is Measure.CAPACITY
    assert trend.change_per_s == pytest.approx(change_per_s, rel=0.3)


@pytest.mark.parametrize("seed", range(20))
def test_noise_of_a_fifth_is_steady(seed: int) -> None:
    rng = random.Random(seed)
    trend = fed([1e6 * math.exp(rng.gauss(0, 0.2)) for _ in range(60)])
    assert trend is not None
    assert trend.direction is Direction.STEADY


def test_what_is_too_short_or_too_long_ago_is_not_judged() -> None:
    assert fed([1e6 * 2**second for second in range(10)]) is None
    link = LinkTrend()
    for second in range(20):
        link.feed(1e6 * 2**second, 0.01, second + 1, float(second))
    assert link.trend is not None
    for second in range(20, 20 + int(WINDOW_S)):
        # nothing is acknowledged any more
        link.feed(1e6, 0.01, 20, float(second))
    assert link.trend is None


def test_the_round_trip_is_judged_while_the_capacity_is_not_measured() -> None:
    link = LinkTrend()
    for second in range(40):
        link.feed(None, 0.02 * 1.05**second, second + 1, float(second))
    assert link.trend is not None
    assert (link.trend.measure, link.trend.direction) == (Measure.ROUND_TRIP, Direction.WORSENING)
    for second in range(40, 60):
        link.feed(1e6, 0.1, second + 1, float(second))
    assert link.trend is not None
    assert (link.trend.measure, link.trend.direction) == (Measure.CAPACITY, Direction.STEADY)


@pytest.mark.parametrize(
    ("factor", "direction"), [(0.96, "worsening"), (1.0, "steady"), (1.04, "improving")], ids=["away", "still", "back"]
)
def test_the_trend_of_a_link_is_that_of_its_rate(factor: float, direction: str) -> None:
    world = World()
    for name in ("a", "b"):
        world.add(settings(name, Topic("bulk", priority=12)))
    world.run(1.5)
    for pipe in world.pipes.values():
        pipe.rate_bits_per_s = 2e6
    world.send("a", "bulk", bytes(40_000_000), "b")
    for _ in range(40):
        world.run(1.0)
        for pipe in world.pipes.values():
            pipe.rate_bits_per_s *= factor
    (peer,) = world.nodes["a"].conditions(world.now).peers
    assert peer.trend is not None
    assert peer.trend.direction.value == direction
    assert peer.trend.measure is Measure.CAPACITY
    assert peer.trend.change_per_s == pytest.approx(math.log(factor), abs=0.01)
    for pipe in world.pipes.values():
        pipe.up = False
    world.run(15.0)
    (peer,) = world.nodes["a"].conditions(world.now).peers
    assert (peer.online, peer.trend, peer.available_bits_per_s) == (False, None, None)
