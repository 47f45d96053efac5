"""A chart of values over time as SVG, for the pictures of the docs. All text is escaped."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from html import escape

WIDTH, HEIGHT = 760, 260
_LEFT, _RIGHT, _TOP, _BOTTOM = 64, 16, 14, 36
# Readable on white and with color vision deficiency (after Okabe and Ito).
COLORS = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00", "#f0e442", "#555555")


def color(index: int) -> str:
    return COLORS[index % len(COLORS)]


def _text(x: float, y: float, text: str, anchor: str = "middle") -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{escape(text)}</text>'


class _Axes:
    """Maps values to coordinates."""

    def __init__(self, x: tuple[float, float], y: tuple[float, float]) -> None:
        self.x0, self.x1 = x
        self.y0, self.y1 = y

    def at_x(self, value: float) -> float:
        return _LEFT + (value - self.x0) / ((self.x1 - self.x0) or 1.0) * (WIDTH - _LEFT - _RIGHT)

    def at_y(self, value: float) -> float:
        return HEIGHT - _BOTTOM - (value - self.y0) / ((self.y1 - self.y0) or 1.0) * (HEIGHT - _TOP - _BOTTOM)

    def lines(self, x_label: str, y_label: str) -> list[str]:
        parts = []
        for value in ticks(self.x0, self.x1):
            x = self.at_x(value)
            parts.append(f'<path class="grid" d="M{x:.1f} {_TOP}V{HEIGHT - _BOTTOM}"/>')
            parts.append(_text(x, HEIGHT - _BOTTOM + 14, f"{value:g}"))
        for value in ticks(self.y0, self.y1, 4):
            y = self.at_y(value)
            parts.append(f'<path class="grid" d="M{_LEFT} {y:.1f}H{WIDTH - _RIGHT}"/>')
            parts.append(_text(_LEFT - 6, y + 4, f"{value:g}", "end"))
        parts.append(_text((WIDTH + _LEFT) / 2, HEIGHT - 4, x_label))
        if y_label:
            parts.append(
                f'<text transform="translate(14 {HEIGHT / 2:.0f}) rotate(-90)" text-anchor="middle">'
                f"{escape(y_label)}</text>"
            )
        return parts


def ticks(low: float, high: float, about: int = 8) -> list[float]:
    """Round numbers between two bounds, at most about `about` of them."""
    span = high - low
    if not span > 0:
        return [low]
    step = 10 ** math.floor(math.log10(span / about))
    step *= next(factor for factor in (1, 2, 5, 10) if span / (step * factor) <= about)
    first = math.ceil(low / step - 1e-9)
    return [round(number * step, 12) for number in range(first, math.floor(high / step + 1e-9) + 1)]


def over_time(series: Mapping[str, Sequence[tuple[float, float]]], end: float, x_label: str, y_label: str) -> str:
    """One line per name through its (seconds, value) points, with gaps where points are missing."""
    values = [value for points in series.values() for _, value in points]
    axes = _Axes((0.0, end), (0.0, max([*values, 1e-9]) * 1.05))
    parts = axes.lines(x_label, y_label)
    for index, points in enumerate(series.values()):
        steps = sorted(later - earlier for (earlier, _), (later, _) in itertools.pairwise(points))
        longest = 2.5 * steps[len(steps) // 2] if steps else 0.0
        drawn, before = "", -math.inf
        for t, value in points:
            drawn += f"{'M' if t - before > longest else 'L'}{axes.at_x(t):.1f} {axes.at_y(value):.1f}"
            before = t
        parts.append(
            f'<path d="{drawn}" fill="none" stroke="{color(index)}" stroke-width="1.5" stroke-linecap="round"/>'
        )
    return f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img">{"".join(parts)}</svg>'
