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

WIDTH = 1200
_EDGE = 40
_MAX_HEIGHT = 4000
# readable by the color-blind: blue for enough margin, orange for less
_COLORS = {"covered": (0, 114, 178), "short": (213, 94, 0), "rock": (200, 200, 200), "ink": (20, 20, 20)}
Color = tuple[int, int, int]


@dataclass(frozen=True, slots=True)
class MapView:
    """What is drawn below the plan: walls, or an occupancy map."""

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
            _EDGE + (self.top_m - place[1]) * self.pixels_per_m,
        )


def _scale(view: MapView, plan: PlacementPlan) -> _Scale:
    places = [at for _, at, _ in plan.steps] + [end for wall in view.walls for end in (wall.a, wall.b)]
    if view.occupancy is not None:
        one = view.occupancy
        right, top = one.origin[0] + one.columns * one.cell_m, one.origin[1] + one.rows * one.cell_m
        places += [one.origin, (right, top)]
    xs, ys = [x for x, _ in places], [y for _, y in places]
    wide, high = max(xs) - min(xs), max(ys) - min(ys)
    room = WIDTH - 2 * _EDGE
    factor = min(room / max(wide, 1.0), (_MAX_HEIGHT - 2 * _EDGE) / max(high, 1.0))
    return _Scale(min(xs), max(ys), factor, math.ceil(2 * _EDGE + high * factor))


def svg(view: MapView, plan: PlacementPlan) -> str:
    """The map, the route (thick where it has the margin, dashed where not), the base and the numbered beacons."""
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
        style = f'stroke="{hexadecimal("covered" if good else "short")}" stroke-width="5"'
        parts.append(line(a, b, style if good else f'{style} stroke-dasharray="3 3"'))
    base = plan.steps[0][1]
    for name, place in (("base", base), *((str(index), one.at) for index, one in enumerate(plan.beacons, 1))):
        x, y = scale.at(place)
        parts.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="7" fill="{hexadecimal("ink")}"/>')
        parts.append(f'<text x="{x + 10:.1f}" y="{y - 10:.1f}" font-size="22">{name}</text>')
    parts.append(f'<text x="{_EDGE}" y="{_EDGE - 14}" font-size="18">{summary(plan)}</text>')
    return "\n".join([*parts, "</svg>", ""])


def summary(plan: PlacementPlan) -> str:
    """The plan in one line."""
    count = len(plan.beacons)
    what = f"{count} beacon{'' if count == 1 else 's'}: {plan.covered_m:.0f} of {plan.length_m:.0f} m"
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
    """The same without its texts; beacons are dots."""
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
    for place in (plan.steps[0][1], *(one.at for one in plan.beacons)):
        dot(*scale.at(place), 7.0, _COLORS["ink"])
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
