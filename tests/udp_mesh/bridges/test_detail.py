"""How detailed reduced messages are: the controller alone, and on a link in virtual time that pauses."""

from __future__ import annotations

import itertools
import math
import random
import statistics
from collections.abc import Iterator

from hypothesis import given
from hypothesis import strategies as st

from udp_mesh.bridges.reduction import (
    DEADBAND,
    TARGET_SHARE,
    DetailController,
    JpegOptions,
    Reducer,
    Reduction,
)

PERIOD_S = 0.25
FINEST_BIT, COARSEST_BIT = 285_000, 54_000
"""A picture of 640 x 480 at JPEG quality 60 and 5."""
FAST_BIT_S, SLOW_BIT_S = 4e6, 0.4e6


@given(st.floats(2, 20), st.floats(0.05, 3.0), st.floats(0.05, 3.0))
def test_the_detail_settles_for_every_link_and_does_not_oscillate(
    ratio: float, first_s: float, second_s: float
) -> None:
    """Latency at detail 1 is `first_s`, then `second_s`, at a period of 1 s; at detail 0, `ratio` times less."""
    controller, now = DetailController(1.0), 0.0
    for full_s in (first_s, second_s):
        details = []
        for _ in range(120):
            latency_s = full_s * ratio ** (controller.detail - 1)
            now += 2.0
            if latency_s > 1.0:
                controller.on_late(now)
            else:
                controller.on_delivered(now, latency_s)
            details.append(controller.detail)
        assert len(set(details[-40:])) == 1, "settled"
        changes = [later - sooner for sooner, later in itertools.pairwise(details) if later != sooner]
        turns = sum((sooner > 0) != (later > 0) for sooner, later in itertools.pairwise(changes))
        assert turns <= 1
        settled_s = full_s * ratio ** (details[-1] - 1)
        if 0 < details[-1] < 1:
            assert abs(math.log(settled_s / TARGET_SHARE)) <= DEADBAND + 1e-6


def test_one_slow_message_changes_nothing() -> None:
    controller = DetailController(1.0)
    for number, latency_s in enumerate((0.4, 0.5, 0.9, 0.5, 0.4, 0.9, 0.4)):
        controller.on_delivered(float(number), latency_s)
    assert controller.detail == 1.0


def test_the_slowest_destination_decides_until_it_is_lost() -> None:
    reducer = Reducer({"camera": Reduction(rate_hz=1.0, encode=JpegOptions(), adapt=True)}, 1)
    assert reducer.adapts("camera")
    assert not reducer.adapts("other")
    for second in range(20):
        reducer.on_outcome("camera", "near", "delivered", 0.01, float(second))
        reducer.on_outcome("camera", "far", "expired", None, float(second))
    assert reducer.detail("camera") == 0.0
    reducer.on_outcome("camera", "far", "peer-lost", None, 20.0)
    # from where it was: nothing is known yet about larger messages
    assert 0.0 < reducer.detail("camera") <= 0.1
    for second in range(20, 120):
        reducer.on_outcome("camera", "near", "delivered", 0.01, float(second))
    assert reducer.detail("camera") == 1.0


def test_messages_that_one_pause_delayed_count_once() -> None:
    """Five messages a second apart arrive together, after a pause of the link; two more were superseded in it."""
    controller = DetailController(1.0)
    for second in range(10):
        controller.on_delivered(second + 0.4, 0.4)
    for published in range(10, 15):
        controller.on_delivered(15.0, 15.0 - published)
    controller.on_late(15.0)
    controller.on_late(15.1)
    for second in range(15, 30):
        controller.on_delivered(second + 0.4, 0.4)
    assert controller.detail == 1.0


def test_a_link_that_carries_nothing_takes_the_detail_down_in_a_few_messages_and_for_any_time() -> None:
    controller = DetailController(1.0)
    details = []
    for second in range(5000):
        controller.on_late(float(second))
        details.append(controller.detail)
    assert details[0] == 1.0, "one alone may be a pause"
    assert set(details[10:]) == {0.0}


def pauses(chance: random.Random, end_s: float) -> Iterator[tuple[float, float]]:
    """When a busy host or link does nothing: 0.1 to 1 s, about every 3 s."""
    now = chance.expovariate(1 / 3)
    while now < end_s:
        until = now + chance.uniform(0.1, 1.0)
        yield now, until
        now = until + chance.expovariate(1 / 3)


def details_on_a_pausing_link(seed: int, rates: list[tuple[float, float]]) -> list[float]:
    """The detail of each message. The link, with (seconds, bit/s), sends one message at a time, the newest next."""
    chance = random.Random(seed)
    stops = list(itertools.accumulate(seconds for seconds, _ in rates))
    paused = list(pauses(chance, stops[-1]))
    controller = DetailController(PERIOD_S)
    details: list[float] = []
    arriving: tuple[float, float] | None = None
    """The message on the link: when it was published, when it arrives."""
    waiting: tuple[float, float] | None = None
    """The message behind it: when it was published, its bits."""

    def sent(published_s: float, start_s: float, bits: float) -> tuple[float, float]:
        rate = next(rate for stop, (_, rate) in zip(stops, rates, strict=True) if start_s < stop or stop == stops[-1])
        done_s = start_s + bits / rate + chance.expovariate(1 / 0.02)
        for begin, end in paused:
            if start_s < end and begin < done_s:
                done_s += end - max(begin, start_s)
        return published_s, done_s

    for number in range(round(stops[-1] / PERIOD_S)):
        now = number * PERIOD_S
        while arriving is not None and arriving[1] <= now:
            published_s, done_s = arriving
            controller.on_delivered(done_s, done_s - published_s)
            arriving = None if waiting is None else sent(waiting[0], done_s, waiting[1])
            waiting = None
        bits = COARSEST_BIT * (FINEST_BIT / COARSEST_BIT) ** controller.detail
        details.append(controller.detail)
        if arriving is None:
            arriving = sent(now, now, bits)
        else:
            if waiting is not None:
                controller.on_late(now)
            waiting = now, bits
    return details


def swings(details: list[float], least: float = 0.2) -> int:
    """How often the detail turned after it had moved by `least`."""
    turns, direction, extreme = 0, 0, details[0]
    for detail in details:
        if direction * (detail - extreme) > 0 or (direction == 0 and abs(detail - extreme) >= least):
            direction = direction or (1 if detail > extreme else -1)
            extreme = detail
        elif direction and abs(detail - extreme) >= least:
            turns, direction, extreme = turns + 1, -direction, detail
    return turns


def test_the_detail_does_not_swing_on_a_link_that_pauses_and_follows_its_rate() -> None:
    runs = [
        details_on_a_pausing_link(seed, [(40.0, FAST_BIT_S), (40.0, SLOW_BIT_S), (80.0, FAST_BIT_S)])
        for seed in range(20)
    ]
    fast, slow, fast_again = ([run[a:b] for run in runs] for a, b in ((0, 160), (160, 320), (320, 640)))
    # with a pause of up to four periods every twelve
    assert statistics.mean(swings(run) for run in fast) <= 1
    assert statistics.mean(swings(run) for run in fast_again) <= 1
    assert statistics.mean(statistics.mean(run) for run in fast) > 0.95
    assert statistics.mean(statistics.mean(run[160:]) for run in fast_again) > 0.95
    # ten times less: coarse within three seconds
    assert statistics.median(next(n for n, detail in enumerate(run) if detail < 0.3) for run in slow) <= 12
    assert statistics.mean(statistics.mean(run[80:]) for run in slow) < 0.2
