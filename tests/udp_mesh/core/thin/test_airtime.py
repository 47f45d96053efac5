"""The duty-cycle budget: no interval of the window's length has more airtime than is allowed, whatever is asked for,
also over restarts and crashes."""

from __future__ import annotations

import random

import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from udp_mesh.core.thin.airtime import AirtimeBudget
from udp_mesh.core.thin.settings import URGENT_SHARE, ThinLinkSettings

WINDOW_S = 600.0


def link(duty_cycle: float) -> ThinLinkSettings:
    return ThinLinkSettings("radio", 1000.0, frame_bytes=60, duty_cycle=duty_cycle, window_s=WINDOW_S)


def most_in_a_window(sent: list[tuple[float, float]], window_s: float) -> float:
    """The largest airtime in any interval of that length; frames count by the part of them that lies in it."""
    most = 0.0
    for start, length in sent:
        # The maximum begins with a frame or ends with one.
        for begin in (start, start + length - window_s):
            inside = [max(0.0, min(at + s, begin + window_s) - max(at, begin)) for at, s in sent]
            most = max(most, sum(inside))
    return most


def use(budget: AirtimeBudget, rng: random.Random, begin: float, seconds: float) -> list[tuple[float, float]]:
    """Send whenever the budget allows it, in frames of random length, urgent or not."""
    sent, now = [], begin
    while now < begin + seconds:
        airtime_s = rng.uniform(0.05, 0.5)
        urgent = rng.random() < 0.5
        ready = budget.ready_at(airtime_s, now, urgent=urgent)
        if ready > now:
            now = min(ready, now + rng.uniform(0.1, 30.0))
            continue
        budget.spend(airtime_s, now, urgent=urgent)
        sent.append((now, airtime_s))
        now += airtime_s + rng.choice((0.0, 0.1, 5.0))
    return sent


@given(st.sampled_from((0.005, 0.01, 0.1)), st.integers(0, 10_000), st.floats(0.0, 2000.0))
@hypothesis_settings(max_examples=25, deadline=None)
def test_no_window_exceeds_the_limit(duty_cycle: float, seed: int, rest_s: float) -> None:
    """Also if a rest has filled the budget."""
    rng = random.Random(seed)
    budget = AirtimeBudget(link(duty_cycle), 5.0)
    sent = use(budget, rng, 5.0 + rest_s, 1000.0)
    sent += use(budget, rng, max(5.0 + rest_s + 1000.0, sent[-1][0] + sent[-1][1]) + WINDOW_S, 1000.0)
    assert most_in_a_window(sent, WINDOW_S) <= duty_cycle * WINDOW_S


@given(st.integers(0, 10_000), st.lists(st.floats(1.0, 900.0), min_size=1, max_size=6))
@hypothesis_settings(max_examples=25, deadline=None)
def test_nor_do_crashes_within_it(seed: int, runs_s: list[float]) -> None:
    """Each run starts without knowing what those before it have sent."""
    rng, now, sent = random.Random(seed), 0.0, [(0.0, 0.0)]
    for run_s in runs_s:
        sent += use(AirtimeBudget(link(0.01), now), rng, now, run_s)
        # The last frame may still be on the air when the process ends.
        now = max(now + run_s, sent[-1][0] + sent[-1][1])
    assert most_in_a_window(sent, WINDOW_S) <= 0.01 * WINDOW_S


def test_the_budget_allows_three_quarters_of_the_limit_for_ever_and_a_quarter_at_once() -> None:
    settings = link(0.01)
    budget = AirtimeBudget(settings, 0.0)
    assert budget.available_s(0.0) == 0
    assert budget.available_s(WINDOW_S) == pytest.approx(settings.burst_s)
    sent = use(budget, random.Random(1), WINDOW_S, 100 * WINDOW_S)
    assert sum(airtime_s for _, airtime_s in sent) > 0.7 * 100 * 0.01 * WINDOW_S


def test_a_part_of_the_budget_is_kept_for_urgent_frames() -> None:
    settings = link(0.01)
    budget, now = AirtimeBudget(settings, 0.0), WINDOW_S
    while budget.ready_at(0.3, now, urgent=False) == now:
        budget.spend(0.3, now, urgent=False)
        now += 0.3
    assert budget.available_s(now) >= URGENT_SHARE * settings.burst_s - 1e-9
    assert budget.ready_at(0.3, now, urgent=True) == now


def test_a_frame_may_be_sent_when_it_was_said_to() -> None:
    budget = AirtimeBudget(link(0.01), 0.0)
    for urgent in (True, False):
        ready = budget.ready_at(0.4, 1.0, urgent=urgent)
        assert ready > 1.0
        assert budget.ready_at(0.4, ready, urgent=urgent) == ready


def test_a_link_without_a_limit_only_counts() -> None:
    budget = AirtimeBudget(link(1.0), 0.0)
    for step in range(3000):
        assert budget.ready_at(1.0, float(step), urgent=False) == step
        budget.spend(1.0, float(step), urgent=False)
    assert budget.total_s == 3000


def test_a_frame_beyond_the_dwell_time_is_never_composed() -> None:
    settings = ThinLinkSettings("us915", 980.0, frame_bytes=200, frame_overhead_bytes=10, max_airtime_s=0.4 + 0.1)
    assert (
        settings.airtime_s(settings.largest_frame_bytes) <= 0.5 < settings.airtime_s(settings.largest_frame_bytes + 1)
    )


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"bits_per_s": 0.0}, "a positive bits_per_s, found 0.0"),
        ({"frame_bytes": 20}, "frame_bytes of 40 to 255, found 20"),
        ({"duty_cycle": 1.5}, "a duty_cycle above 0 up to 1, found 1.5"),
        ({"duty_cycle": 1e-5}, "frames of at most 0.007 s for this duty_cycle, found 1.600 s"),
        ({"max_airtime_s": 0.1}, "max_airtime_s of at least 0.320"),
        ({"name": "two words"}, "a name without white space"),
    ],
)
def test_settings_that_cannot_work_are_refused(changes: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        ThinLinkSettings(**{"name": "radio", "bits_per_s": 1000.0, **changes})  # type: ignore[arg-type]
