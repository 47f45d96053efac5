"""Waiting for real parts: asked again and again until it is so, with a bound that no busy machine comes near."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TypeVar

T = TypeVar("T")

# Between two looks: short beside what anything real takes, long beside what most conditions cost.
LOOK_S = 0.02


def until(condition: Callable[[], T | None], what: str, *, wait_s: float = 60.0, look_s: float = LOOK_S) -> T:
    """The condition's first answer that is neither None nor False; fails naming `what` after `wait_s`."""
    deadline = time.monotonic() + wait_s
    while True:
        value = condition()
        if value is not None and value is not False:
            return value
        assert time.monotonic() < deadline, f"waited {wait_s:g} s for {what}"
        time.sleep(look_s)
