"""A stop reaches a large team over a thin link, although all nodes started at one moment."""

from __future__ import annotations

import pytest

from benchmarks.thin_links import LINKS, stop

TEAM = 10


@pytest.mark.parametrize("seed", [2, 6])
def test_nodes_with_equal_budgets_do_not_collide_forever(seed: int) -> None:
    """Their budgets suffice for the next frame at one moment; two that always collide are never heard."""
    (limited,) = (link for link in LINKS if link.duty_cycle == 0.01)
    took_s, _, _ = stop(limited, TEAM, 0.0, seed)
    assert took_s is not None
    assert took_s < 10.0
