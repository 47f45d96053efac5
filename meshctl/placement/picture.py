"""A placement plan as a picture: SVG, and PNG for reports that take no SVG. Pure."""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

from meshctl.placement.occupancy_map import OccupancyMap
from meshctl.placement.path_loss import Point, Wall
from meshctl.placement.planner import PlacementPlan
from meshctl.wording import counted

WIDTH = 1200
_EDGE = 40
# above the map, for the summary and the first labels, and below it, for the scale
_HEAD = 76
_FOOT = 60
_BEACON = 8.0
_MAX_HEIGHT = 4000
# readable by the color-blind: blue for enough margin, orange for less
_COLORS = {"covered": (0, 114, 178), "short": (213, 94, 0), "rock": (200, 200, 200), "ink": (20, 20, 20)}
Color = tuple[int, int, int]
# Digits of 3 by 5 squares, row by row.
_DIGITS = {
    "0": "111101101101111", "1": "010110010010111", "2": "111001111100111", "3": "111001111001111",
    "4": "101101111001001", "5": "111100111001111", "6": "111100111101111", "7": "111001010010010",
    "8": "111101111101111", "9": "111101111001111",
}  # fmt: skip
_DIGIT_SIDE = 3


@dataclass(frozen=True, slots=True)
class MapView:
    """The background of the plan: walls, or an occupancy map."""

    walls: tuple[Wall, ...] = ()
    occupancy: OccupancyMap | None = None


@dataclass(frozen=True, slots=True)
class _Scale:
    left_m: float
    top_m: float
    pixels_per_m: float
    height: int

    def at(self, place: Point) -> tuple[float, float]:
        return (
            _EDGE + (place[0] - self.left_m) * self.pixels_per_m,
            _HEAD + (self.top_m - place[1]) * self.pixels_per_m,
        )


def _scale(view: MapView, plan: PlacementPlan) -> _Scale:
    places = [at for _, at, _ in plan.steps] + [end for wall in view.walls for end in (wall.a, wall.b)]
    if view.occupancy is not None:
        occupancy = view.occupancy
        right, top = (
            occupancy.origin[0] + occupancy.columns * occupancy.cell_m,
            occupancy.origin[1] + occupancy.rows * occupancy.cell_m,
        )
        places += [occupancy.origin, (right, top)]
    xs, ys = [x for x, _ in places], [y for _, y in places]
    wide, high = max(xs) - min(xs), max(ys) - min(ys)
    room = WIDTH - 2 * _EDGE
    factor = min(room / max(wide, 1.0), (_MAX_HEIGHT - _HEAD - _FOOT) / max(high, 1.0))
    return _Scale(min(xs), max(ys), factor, math.ceil(_HEAD + high * factor + _FOOT))


def _bar_m(scale: _Scale) -> int:
    """The round number of meters that takes at most a fifth of the picture; at least 1."""
    longest_m = max(1.0, WIDTH / 5 / scale.pixels_per_m)
    decade = 10 ** math.floor(math.log10(longest_m))
    return int(next(times * decade for times in (5, 2, 1) if times * decade <= longest_m))


def svg(view: MapView, plan: PlacementPlan) -> str:
    """The map, the route (thick where it has the margin, thin where not), the base and the numbered beacons."""
    scale = _scale(view, plan)

    def hexadecimal(name: str) -> str:
        return "#{:02x}{:02x}{:02x}".format(*_COLORS[name])

    def line(a: Point, b: Point, style: str) -> str:
        (x0, y0), (x1, y1) = scale.at(a), scale.at(b)
        return f'<path d="M{x0:.1f} {y0:.1f}L{x1:.1f} {y1:.1f}" {style}/>'

    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {scale.height}" font-family="sans-serif">',
        f'<rect width="{WIDTH}" height="{scale.height}" fill="white"/>',
    ]
    if view.occupancy is not None:
        parts += [
            f'<rect x="{x:.1f}" y="{y:.1f}" width="{wide:.1f}" height="{high:.1f}" fill="{hexadecimal("rock")}"/>'
            for x, y, wide, high in _blocks(view.occupancy, scale)
        ]
    parts += [line(wall.a, wall.b, f'stroke="{hexadecimal("ink")}" stroke-width="2"') for wall in view.walls]
    for (_, a, before_db), (_, b, after_db) in pairwise(plan.steps):
        good = min(before_db, after_db) >= plan.margin_db
        color, wide = (hexadecimal("covered"), 5) if good else (hexadecimal("short"), 2)
        parts.append(line(a, b, f'stroke="{color}" stroke-width="{wide}" stroke-linecap="round"'))
    ink = hexadecimal("ink")
    x, y = scale.at(plan.steps[0][1])
    parts.append(f'<rect x="{x - 9:.1f}" y="{y - 9:.1f}" width="18" height="18" fill="{ink}"/>')
    parts.append(f'<text x="{x + 12:.1f}" y="{y - 14:.1f}" font-size="20" font-weight="bold">base</text>')
    for number, beacon in enumerate(plan.beacons, 1):
        x, y = scale.at(beacon.at)
        corners = f"M{x:.1f} {y - _BEACON:.1f}l{_BEACON} {_BEACON}l-{_BEACON} {_BEACON}l-{_BEACON} -{_BEACON}z"
        parts.append(f'<path d="{corners}" fill="{ink}"/>')
        parts.append(
            f'<text x="{x + 12:.1f}" y="{y - 14:.1f}" font-size="20"><tspan font-weight="bold">{number}</tspan>'
            f'<tspan dx="8" font-size="15">{beacon.margin_db:.0f} dB</tspan></text>'
        )
    parts.append(f'<text x="{_EDGE}" y="{_EDGE / 2 + 8:.0f}" font-size="18">{summary(plan)}</text>')
    bar_m, floor = _bar_m(scale), scale.height - _FOOT / 4
    end = _EDGE + bar_m * scale.pixels_per_m
    parts.append(f'<path d="M{_EDGE} {floor - 5}v5H{end:.1f}v-5" fill="none" stroke="{ink}" stroke-width="2"/>')
    parts.append(f'<text x="{end + 8:.1f}" y="{floor}" font-size="15">{bar_m} m</text>')
    key = "beacons with the margin of the link to the one before; thin: below the margin"
    parts.append(f'<text x="{WIDTH - _EDGE}" y="{floor}" font-size="15" text-anchor="end">{key}</text>')
    return "\n".join([*parts, "</svg>", ""])


def summary(plan: PlacementPlan) -> str:
    """The plan in one line."""
    count = len(plan.beacons)
    what = f"{counted(count, 'beacon')}: {plan.covered_m:.0f} of {plan.length_m:.0f} m"
    return f"{what} with a margin of {plan.margin_db:g} dB"


def _blocks(occupancy: OccupancyMap, scale: _Scale) -> list[tuple[float, float, float, float]]:
    """Runs of cells that are not free, as x, y, width and height in pixels."""
    found = []
    side = occupancy.cell_m * scale.pixels_per_m
    for row in range(occupancy.rows):
        start: int | None = None
        for column in range(occupancy.columns + 1):
            blocked = column < occupancy.columns and not occupancy.is_free(column, row)
            if blocked and start is None:
                start = column
            elif not blocked and start is not None:
                corner = (
                    occupancy.origin[0] + start * occupancy.cell_m,
                    occupancy.origin[1] + (row + 1) * occupancy.cell_m,
                )
                x, y = scale.at(corner)
                found.append((x, y, (column - start) * side, side))
                start = None
    return found


def png(view: MapView, plan: PlacementPlan) -> bytes:
    """The same with digits as its only text."""
    scale = _scale(view, plan)
    canvas = bytearray(b"\xff" * (3 * WIDTH * scale.height))

    def dot(x: float, y: float, radius: float, color: Color) -> None:
        for row in range(max(0, math.floor(y - radius)), min(scale.height, math.ceil(y + radius) + 1)):
            reach = radius * radius - (row - y) ** 2
            if reach >= 0:
                left = max(0, math.ceil(x - math.sqrt(reach)))
                right = min(WIDTH, math.floor(x + math.sqrt(reach)) + 1)
                canvas[3 * (row * WIDTH + left) : 3 * (row * WIDTH + right)] = bytes(color) * max(0, right - left)

    def line(a: Point, b: Point, radius: float, color: Color) -> None:
        (x0, y0), (x1, y1) = scale.at(a), scale.at(b)
        steps = max(1, math.ceil(math.dist((x0, y0), (x1, y1)) / max(radius, 0.5)))
        for step in range(steps + 1):
            dot(x0 + (x1 - x0) * step / steps, y0 + (y1 - y0) * step / steps, radius, color)

    if view.occupancy is not None:
        for x, y, wide, high in _blocks(view.occupancy, scale):
            span = bytes(_COLORS["rock"]) * max(1, round(wide))
            for row in range(round(y), min(scale.height, round(y + high))):
                start = 3 * (row * WIDTH + round(x))
                canvas[start : start + len(span)] = span
    for wall in view.walls:
        line(wall.a, wall.b, 1.0, _COLORS["ink"])
    for (_, a, before_db), (_, b, after_db) in pairwise(plan.steps):
        good = min(before_db, after_db) >= plan.margin_db
        line(a, b, 2.5 if good else 1.5, _COLORS["covered" if good else "short"])

    def block(left: float, top: float, wide: float, high: float) -> None:
        for row in range(max(0, round(top)), min(scale.height, round(top + high))):
            start, end = max(0, round(left)), min(WIDTH, round(left + wide))
            canvas[3 * (row * WIDTH + start) : 3 * (row * WIDTH + end)] = bytes(_COLORS["ink"]) * max(0, end - start)

    def digits(text: str, left: float, top: float) -> None:
        for place, digit in enumerate(text):
            for index, is_set in enumerate(_DIGITS[digit]):
                if is_set == "1":
                    x = left + (4 * place + index % 3) * _DIGIT_SIDE
                    block(x, top + index // 3 * _DIGIT_SIDE, _DIGIT_SIDE, _DIGIT_SIDE)

    x, y = scale.at(plan.steps[0][1])
    block(x - 9, y - 9, 18, 18)
    for number, beacon in enumerate(plan.beacons, 1):
        x, y = scale.at(beacon.at)
        dot(x, y, _BEACON, _COLORS["ink"])
        digits(str(number), x + 11, y - 26)
    bar_m, floor = _bar_m(scale), scale.height - _FOOT / 4
    block(_EDGE, floor - 2, bar_m * scale.pixels_per_m, 2)
    digits(str(bar_m), _EDGE + bar_m * scale.pixels_per_m + 8, floor - 14)
    return _png(bytes(canvas), WIDTH, scale.height)


def _png(pixels: bytes, width: int, height: int) -> bytes:
    """RGB pixels as a PNG file (RFC 2083)."""
    rows = b"".join(b"\0" + pixels[3 * width * row : 3 * width * (row + 1)] for row in range(height))
    chunks: Sequence[tuple[bytes, bytes]] = (
        (b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)),
        (b"IDAT", zlib.compress(rows, 6)),
        (b"IEND", b""),
    )
    body = b"".join(
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data)) for kind, data in chunks
    )
    return b"\x89PNG\r\n\x1a\n" + body
