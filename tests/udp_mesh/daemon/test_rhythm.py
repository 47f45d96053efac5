"""When the driver looks at everything once per tick: only where wake-ups come often and carry little."""

import pytest

from udp_mesh.daemon.rhythm import IDLE_TICKS, TICK_S, WINDOW_S, Rhythm


def run(rhythm: Rhythm, seconds: float, interval_s: float, datagrams: int, start: float = 100.0) -> bool:
    """Wakes at this interval for so long; returns whether it ticks in the end."""
    for turn in range(int(seconds / interval_s)):
        rhythm.woke(start + turn * interval_s, datagrams)
    return rhythm.ticking


@pytest.mark.parametrize(
    ("interval_s", "datagrams", "ticks"),
    [
        (0.001, 1, True),  # a radio at 10 Mbit/s
        (0.003, 3, True),  # a paced sender
        (0.05, 1, False),  # telemetry at 20 Hz
        (0.001, 64, False),  # a wire: each wake-up is worth it
    ],
)
def test_ticking_begins_where_wake_ups_come_often_and_carry_little(
    interval_s: float, datagrams: int, ticks: bool
) -> None:
    assert run(Rhythm(), 5 * WINDOW_S, interval_s, datagrams) is ticks


def test_one_burst_does_not_begin_it() -> None:
    rhythm = Rhythm()
    run(rhythm, 0.02, 0.001, 1)
    assert not rhythm.woke(200.0, 1)
    assert not rhythm.ticking


def test_silence_ends_it_and_large_batches_end_it() -> None:
    rhythm = Rhythm()
    assert run(rhythm, 5 * WINDOW_S, 0.001, 1)
    changes = [rhythm.woke(101.0 + turn * TICK_S, 0) for turn in range(IDLE_TICKS)]
    assert changes == [False] * (IDLE_TICKS - 1) + [True]
    assert not rhythm.ticking
    assert run(rhythm, 5 * WINDOW_S, 0.001, 1, start=200.0)
    assert rhythm.woke(201.0, 500)
    assert not rhythm.ticking
