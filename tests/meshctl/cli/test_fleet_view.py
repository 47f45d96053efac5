"""Deadlines of queries: a radio that lost power must not hold up the snapshot for longer than documented."""

from __future__ import annotations

import pytest

from meshctl.cli.fleet_view import query_deadlines


@pytest.mark.parametrize("connect_s", [0.5, 5.0, 30.0])
def test_every_step_has_twice_the_time_to_connect(connect_s: float) -> None:
    """A kept connection was silent for 20 s whatever `--timeout` was, and the monitor showed nothing new meanwhile."""
    limits = query_deadlines(connect_s)
    assert limits.connect_s == connect_s
    steps = {limits.handshake_s, limits.auth_s, limits.channel_s, limits.silence_s}
    assert steps == {2 * connect_s}
    # a radio that computes answers a keepalive in that time
    assert limits.ask_s <= limits.silence_s / 2
