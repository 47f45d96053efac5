"""Durations keep about two digits, in the largest unit that fits twice."""

from __future__ import annotations

import pytest

from meshctl.report.duration import duration


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0.0, "0 s"),
        (119.0, "119 s"),
        (120.0, "2 min"),
        (7199.0, "120 min"),
        (7200.0, "2.0 h"),
        (12 * 3600.0, "12 h"),
        (3 * 86400.0, "3 d"),
        (20 * 31557600.0, "20 years"),
    ],
)
def test_the_unit_depends_on_the_duration(seconds: float, text: str) -> None:
    assert duration(seconds) == text
