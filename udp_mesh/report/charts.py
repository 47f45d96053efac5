"""SVG charts: densities, time spans, stacked areas, time series, paths in a plane. All text is escaped."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from html import escape

WIDTH, HEIGHT = 760, 260
_LEFT, _RIGHT, _TOP, _BOTTOM = 64, 16, 14, 36
_MAX_ROW_NAME = 9
"""Maximum length of a row's label; a tooltip shows longer names."""
# Readable on white and with color vision deficiency (after Okabe and Ito).
COLORS = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00", "#f0e442", "#555555")


def color(index: int) -> str:
    return COLORS[index % len(COLORS)]


def _svg(parts: Sequence[str], height: int = HEIGHT) -> str:
    return f'<svg viewBox="0 0 {WIDTH} {height}" role="img">{"".join(parts)}</svg>'


def _text(x: float, y: float, text: str, anchor: str = "middle") -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{escape(text)}</text>'


class _Axes:
    """Maps values to coordinates."""

    def __init__(self, x: tuple[float, float], y: tuple[float, float], height: int = HEIGHT) -> None:
        self.x0, self.x1 = x
        self.y0, self.y1 = y
        self.height = height

    def at_x(self, value: float) -> float:
        return _LEFT + (value - self.x0) / ((self.x1 - self.x0) or 1.0) * (WIDTH - _LEFT - _RIGHT)

    def at_y(self, value: float) -> float:
        return self.height - _BOTTOM - (value - self.y0) / ((self.y1 - self.y0) or 1.0) * (self.height - _TOP - _BOTTOM)

    def lines(self, x_label: str, y_label: str) -> list[str]:
        parts = []
        for value in ticks(self.x0, self.x1):
            x = self.at_x(value)
            parts.append(f'<path class="grid" d="M{x:.1f} {_TOP}V{self.height - _BOTTOM}"/>')
            parts.append(_text(x, self.height - _BOTTOM + 14, f"{value:g}"))
        for value in ticks(self.y0, self.y1, 4):
            y = self.at_y(value)
            parts.append(f'<path class="grid" d="M{_LEFT} {y:.1f}H{WIDTH - _RIGHT}"/>')
            parts.append(_text(_LEFT - 6, y + 4, f"{value:g}", "end"))
        parts.append(_text((WIDTH + _LEFT) / 2, self.height - 4, x_label))
        if y_label:
            parts.append(
                f'<text transform="translate(14 {self.height / 2:.0f}) rotate(-90)" text-anchor="middle">'
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


def density(bars: Sequence[float], low: float, high: float, curve: tuple[float, float] | None, x_label: str) -> str:
    """Bars of a density, with a normal curve (mean, deviation) for comparison."""

    def normal(value: float, mean: float, deviation: float) -> float:
        return math.exp(-(((value - mean) / deviation) ** 2) / 2) / (deviation * math.sqrt(2 * math.pi))

    points = [low + (high - low) * i / 200 for i in range(201)]
    curved = [normal(value, *curve) for value in points] if curve else []
    axes = _Axes((low, high), (0.0, max([*bars, *curved, 1e-9]) * 1.05))
    parts = axes.lines(x_label, "density")
    width = (high - low) / max(len(bars), 1)
    for index, value in enumerate(bars):
        x, y = axes.at_x(low + index * width), axes.at_y(value)
        w = axes.at_x(low + (index + 1) * width) - x
        parts.append(
            f'<rect x="{x:.1f}" y="{y:.1f}" width="{w:.1f}" height="{axes.at_y(0) - y:.1f}" fill="{COLORS[0]}"/>'
        )
    if curved:
        path = " ".join(f"{axes.at_x(v):.1f},{axes.at_y(d):.1f}" for v, d in zip(points, curved, strict=True))
        parts.append(f'<polyline points="{path}" fill="none" stroke="{COLORS[5]}" stroke-width="1.5"/>')
    return _svg(parts)


def spans(rows: Mapping[str, Sequence[tuple[float, float]]], end: float, x_label: str) -> str:
    """One row per name with bars from start to end."""
    height = _TOP + _BOTTOM + 24 * max(len(rows), 1)
    axes = _Axes((0.0, end), (0.0, float(len(rows))), height)
    parts = [
        part for part in _Axes((0.0, end), (0.0, 0.0), height).lines(x_label, "") if 'text-anchor="end"' not in part
    ]
    for index, (name, bars) in enumerate(rows.items()):
        y = _TOP + 24 * index
        shown = name if len(name) <= _MAX_ROW_NAME else f"{name[: _MAX_ROW_NAME - 1]}…"
        parts.append(f"<g><title>{escape(name)}</title>{_text(_LEFT - 6, y + 16, shown, 'end')}</g>")
        for start, stop in bars:
            x = axes.at_x(start)
            parts.append(
                f'<rect x="{x:.1f}" y="{y + 4}" width="{max(axes.at_x(stop) - x, 0.5):.1f}" height="16" '
                f'fill="{color(index)}"/>'
            )
    return _svg(parts, height)


def stacked(layers: Mapping[str, Sequence[float]], end: float, x_label: str, y_label: str) -> str:
    """Stacked areas, the first at the bottom; all of the same length."""
    length = max((len(values) for values in layers.values()), default=0)
    tops = [sum(values[i] for values in layers.values()) for i in range(length)]
    axes = _Axes((0.0, end), (0.0, max([*tops, 1e-9]) * 1.05))
    parts = axes.lines(x_label, y_label)
    below = [0.0] * length
    for index, values in enumerate(layers.values()):
        above = [low + value for low, value in zip(below, values, strict=True)]
        xs = [axes.at_x((i + 0.5) * end / max(length, 1)) for i in range(length)]
        outline = [f"{x:.1f},{axes.at_y(v):.1f}" for x, v in zip(xs, above, strict=True)]
        outline += [f"{x:.1f},{axes.at_y(v):.1f}" for x, v in reversed(list(zip(xs, below, strict=True)))]
        parts.append(f'<polygon points="{" ".join(outline)}" fill="{color(index)}"/>')
        below = above
    return _svg(parts)


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
    return _svg(parts)


def paths(tracks: Mapping[str, Sequence[tuple[float, float, bool]]], marks: Mapping[str, tuple[float, float]]) -> str:
    """Tracks in a plane (x, y, connected) in meters, colored where connected, otherwise gray; and labeled places."""
    points = [(x, y) for track in tracks.values() for x, y, _ in track] + list(marks.values())
    if not points:
        return ""
    xs, ys = [x for x, _ in points], [y for _, y in points]
    wide = max(max(xs) - min(xs), 1.0)
    high = max(max(ys) - min(ys), wide * 0.1)
    height = min(600, max(160, int((WIDTH - _LEFT - _RIGHT) * high / wide) + _TOP + _BOTTOM))
    axes = _Axes((min(xs), min(xs) + wide), (min(ys), min(ys) + high), height)
    parts = axes.lines("meters", "meters")
    for index, track in enumerate(tracks.values()):
        # One path per section rather than per step: an hour has thousands of steps.
        for on, steps in itertools.groupby(itertools.pairwise(track), key=lambda step: step[1][2]):
            stretch = list(steps)
            places = [stretch[0][0], *(end for _, end in stretch)]
            points_text = [f"{axes.at_x(x):.1f} {axes.at_y(y):.1f}" for x, y, _ in places]
            # A robot that does not move is drawn as a dot.
            drawn = "L".join([points_text[0], *(text for text, _ in itertools.groupby(points_text))])
            parts.append(
                f'<path d="M{drawn}" fill="none" stroke="{color(index) if on else "#bbb"}" '
                f'stroke-width="{3 if on else 1.5}" stroke-linejoin="round" stroke-linecap="round"/>'
            )
    for name, (x, y) in marks.items():
        parts.append(f'<circle cx="{axes.at_x(x):.1f}" cy="{axes.at_y(y):.1f}" r="4" fill="#222"/>')
        parts.append(_text(axes.at_x(x) + 6, axes.at_y(y) - 5, name, "start"))
    return _svg(parts, height)


def legend(names: Sequence[str]) -> str:
    items = "".join(
        f'<span><i style="background:{color(index)}"></i>{escape(name)}</span>' for index, name in enumerate(names)
    )
    return f'<p class="legend">{items}</p>'
