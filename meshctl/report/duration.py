"""The one format of durations and ages in texts."""

from __future__ import annotations


def duration(seconds: float) -> str:
    """`4 s`, `12 min`, `3.5 h`, `2 d`, `3 years`."""
    for limit, unit_s, unit in ((120, 1, "s"), (7200, 60, "min"), (172800, 3600, "h"), (63072000, 86400, "d")):
        if seconds < limit:
            value = seconds / unit_s
            return f"{value:.1f} {unit}" if unit == "h" and value < 10 else f"{value:.0f} {unit}"
    return f"{seconds / 31536000:.0f} years"
