"""The outcome of a package installation on a node whose flash is too full for it."""

from __future__ import annotations

import pytest

from meshctl.apply.packages import with_full_flash
from meshctl.device.observation import Space
from meshctl.fleet import Outcome, Result

WHY = "the files could not be written, or the packages could not be installed"


def flash(free_kib: int) -> Space:
    return Space("/", 8 << 20, free_kib << 10)


@pytest.mark.parametrize("result", [Result.REFUSED, Result.ROLLED_BACK])
def test_an_installation_for_which_there_was_no_flash_says_so(result: Result) -> None:
    outcome = with_full_flash(Outcome("b02", result, WHY), flash(200), (300 << 10) + 1)
    assert outcome.result is result
    assert outcome.reason == f"{WHY} (200 KiB of flash were free; the package files have 301 KiB)"
    assert "du -ak /overlay" in outcome.hint


@pytest.mark.parametrize(
    ("outcome", "found"),
    [
        (Outcome("b02", Result.ROLLED_BACK, WHY), flash(301)),
        (Outcome("b02", Result.ROLLED_BACK, WHY), None),
        (Outcome("b02", Result.DONE), flash(200)),
        (Outcome("b02", Result.UNCERTAIN, "unreachable"), flash(200)),
    ],
)
def test_other_outcomes_stay_as_they_are(outcome: Outcome, found: Space | None) -> None:
    assert with_full_flash(outcome, found, 300 << 10) is outcome
