"""Waiting for real parts: asked again and again until it is so, with a bound that no busy machine comes near."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TypeVar

T = TypeVar("T")

# Between two looks: short beside what anything real takes, long beside what most conditions cost.
LOOK_S = 0.02
# What one look may take off the patience. A test that was not running for longer (a machine that was paused, a process
# that was stopped) has not waited all that time: what it waits for has not run either.
LONGEST_LOOK_S = 5.0


def until(condition: Callable[[], T | None], what: str, *, wait_s: float = 60.0, look_s: float = LOOK_S) -> T:
    """The condition's first answer that is neither None nor False; fails naming `what` after `wait_s`."""
    waited_s, last = 0.0, time.monotonic()
    while True:
        value = condition()
        if value is not None and value is not False:
            return value
        assert waited_s < wait_s, f"waited {wait_s:g} s for {what}"
        time.sleep(look_s)
        now = time.monotonic()
        waited_s, last = waited_s + min(now - last, LONGEST_LOOK_S), now
