"""Pings of several sizes show within a round trip which sizes a path carries, and loss alone does not."""

import random

import pytest

from udp_mesh.core.sender.size_comparison import (
    INTERVAL_S,
    MAX_CHANCE,
    MAX_CONTROLS_LOST,
    MIN_DECIDED,
    MIN_GRACE_S,
    START_AFTER_S,
    SizeComparisons,
)


@pytest.mark.parametrize("loss", [0.05, 0.2, 0.5])
def test_comparisons_rarely_condemn_a_path_that_loses_all_sizes_alike(loss: float) -> None:
    rng = random.Random(11)
    condemned = 0
    for _ in range(3000):
        comparisons = SizeComparisons()
        comparisons.start(0.0)
        now = START_AFTER_S
        for number in range(20):
            comparisons.on_sent({2 * number: 1500, 2 * number + 1: 576}, now, None)
            answered = [rng.random() < (1 - loss) ** 2 for _ in range(2)]
            if answered[0]:
                break
            if answered[1]:
                comparisons.on_pong(2 * number + 1, now + 0.02)
            comparisons.settle(now + 2.0)
            if comparisons.chance(loss) < MAX_CHANCE:
                condemned += 1
                break
            now += INTERVAL_S
    # The losses of data have to be improbable, too: by another factor of a thousand.
    assert condemned <= 9


@pytest.mark.parametrize("mtu", [1500, 1280, 576])
def test_comparisons_find_the_largest_size_that_arrives(mtu: int) -> None:
    comparisons = SizeComparisons()
    comparisons.start(0.0)
    sent, now = 0, 0.0
    answers: list[tuple[float, int]] = []
    while now < 3.0 and comparisons.running:
        now = min([comparisons.next_at, *(at for at, _ in answers)])
        for at, token in list(answers):
            if at <= now:
                answers.remove((at, token))
                comparisons.on_pong(token, now)
        comparisons.settle(now)
        if comparisons.due(now):
            tokens = {sent + place: size for place, size in enumerate((1500, 1280, 576))}
            comparisons.on_sent(tokens, now, None)
            answers += [(now + 0.1, token) for token, size in tokens.items() if size <= mtu]
            sent += 3
        if comparisons.chance(0.0) < MAX_CHANCE:
            break
    assert now < 0.1 + START_AFTER_S + MIN_DECIDED * INTERVAL_S + MIN_GRACE_S
    assert comparisons.largest_arriving() == mtu


def test_comparisons_pause_while_the_path_is_down_and_leave_room_on_slow_links() -> None:
    comparisons = SizeComparisons()
    comparisons.start(0.0)
    sent_at: list[float] = []
    while comparisons.running:
        now = comparisons.next_at
        comparisons.settle(now)
        if comparisons.due(now):
            comparisons.on_sent(
                {3 * len(sent_at) + place: size for place, size in enumerate((1500, 1280, 576))}, now, 20.0
            )
            sent_at.append(now)
    assert MAX_CONTROLS_LOST <= len(sent_at) <= 2 * MAX_CONTROLS_LOST
    # Three packets at 20 packets a second and a quarter of the link: 0.6 s.
    assert sent_at[1] - sent_at[0] == pytest.approx(0.6)
    comparisons.start(100.0)
    assert comparisons.running
