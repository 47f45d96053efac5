"""An occupancy map as ROS map_server writes it: a YAML file with resolution and origin, and a PGM image.

    image: mine.pgm                  # beside the YAML file; P5 or P2
    resolution: 0.05                 # meters per pixel
    origin: [-10.0, -5.0, 0.0]       # the lower left pixel: x, y, yaw (0)
    negate: 0
    occupied_thresh: 0.65
    free_thresh: 0.196

Source: http://wiki.ros.org/map_server, "Map format". For planning, pixels are merged into cells of at least
`MIN_CELL_M`: a cell with an occupied pixel is occupied, one without a free pixel is unknown. Neither is driven through,
and either weakens signals.
"""

from __future__ import annotations

import heapq
import math
import re
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from meshctl.diagnostics import Diagnostic, InvalidInput, Position
from meshctl.errors import InputError
from meshctl.inventory import codes
from meshctl.inventory.yaml_entries import YamlEntry
from meshctl.placement.path_loss import Point

MIN_CELL_M = 0.25
MAX_PIXELS = 64_000_000
_MAX_RESOLUTION_M = 10.0
_DIAGONAL = math.sqrt(2.0)
_STEPS = tuple((dx, dy) for dx in (-1, 0, 1) for dy in (-1, 0, 1) if dx or dy)


@dataclass(frozen=True, slots=True)
class OccupancyMap:
    """`free` is one byte per cell, row by row from the lower left: 1 free, 0 occupied or unknown."""

    origin: Point
    cell_m: float
    columns: int
    rows: int
    free: bytes

    def cell(self, at: Point) -> tuple[int, int]:
        return math.floor((at[0] - self.origin[0]) / self.cell_m), math.floor((at[1] - self.origin[1]) / self.cell_m)

    def is_free(self, column: int, row: int) -> bool:
        return 0 <= column < self.columns and 0 <= row < self.rows and bool(self.free[row * self.columns + column])

    def center(self, column: int, row: int) -> Point:
        return (self.origin[0] + (column + 0.5) * self.cell_m, self.origin[1] + (row + 0.5) * self.cell_m)

    def wall_count(self, a: Point, b: Point) -> int:
        """How many times the straight line between two places enters what is not free."""
        steps = max(1, math.ceil(math.dist(a, b) / self.cell_m))
        count, was_free = 0, True
        for step in range(steps + 1):
            share = step / steps
            here = self.is_free(*self.cell((a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1]))))
            count += was_free and not here
            was_free = here
        return count

    def way(self, stops: tuple[Point, ...]) -> tuple[Point, ...]:
        """The shortest way through free cells along these stops. Raises InputError if there is none."""
        found: list[Point] = [stops[0]]
        for a, b in pairwise(stops):
            found += [*[self.center(*cell) for cell in self._way(a, b)][1:-1], b]
        return tuple(found)

    def _way(self, a: Point, b: Point) -> list[tuple[int, int]]:
        """A* over eight neighbors."""
        start, goal = self.cell(a), self.cell(b)
        for place, cell in ((a, start), (b, goal)):
            if not self.is_free(*cell):
                raise InputError(
                    f"the route's point {place[0]:g}, {place[1]:g} is not in free space of the map",
                    hint=f"the map covers {self.origin[0]:g}, {self.origin[1]:g} to "
                    f"{self.origin[0] + self.columns * self.cell_m:g}, {self.origin[1] + self.rows * self.cell_m:g}",
                )
        before: dict[tuple[int, int], tuple[int, int] | None] = {}
        costs = {start: 0.0}
        queue: list[tuple[float, tuple[int, int], tuple[int, int] | None]] = [(math.dist(start, goal), start, None)]
        while queue:
            _, cell, came_from = heapq.heappop(queue)
            if cell in before:
                continue
            before[cell] = came_from
            if cell == goal:
                return _backward(before, goal)
            for dx, dy in _STEPS:
                other = (cell[0] + dx, cell[1] + dy)
                cost = costs[cell] + (_DIAGONAL if dx and dy else 1.0)
                if self.is_free(*other) and cost < costs.get(other, math.inf):
                    costs[other] = cost
                    heapq.heappush(queue, (cost + math.dist(other, goal), other, cell))
        raise InputError(f"the map has no free way from {a[0]:g}, {a[1]:g} to {b[0]:g}, {b[1]:g}")


def _backward(before: dict[tuple[int, int], tuple[int, int] | None], goal: tuple[int, int]) -> list[tuple[int, int]]:
    cells, cell = [goal], before[goal]
    while cell is not None:
        cells.append(cell)
        cell = before[cell]
    return cells[::-1]


def is_map(root: YamlEntry) -> bool:
    """Whether a YAML file is such a map: it names an image."""
    return "image" in root.mapping()


def read_map(root: YamlEntry, path: Path) -> OccupancyMap:
    """The map of a YAML file's root entry. Raises InvalidInput with every problem of the YAML file or the first of the
    image, with file and line."""
    keys = root.mapping(
        ("image", "resolution", "origin", "negate", "occupied_thresh", "free_thresh", "mode"),
        required=("image", "resolution", "origin"),
    )
    resolution_m = keys["resolution"].number(0.05, 1e-4, _MAX_RESOLUTION_M)
    origin = keys["origin"].row(3, "[x, y, yaw]") or [0.0, 0.0, 0.0]
    if origin[2] != 0.0:
        keys["origin"].problem("a yaw of 0", f"{origin[2]:g}")
    negate = keys["negate"].text() in ("1", "true") if keys["negate"].is_present else False
    free_below = keys["free_thresh"].number(0.196, 0.0, 1.0)
    occupied_above = keys["occupied_thresh"].number(0.65, 0.0, 1.0)
    image = keys["image"].text()
    root.finish()
    pixels, width, height, white = read_pgm(path.parent / image)
    # trinary, scale and raw differ above the threshold of free space only
    limit = free_below * white
    merged = max(1, math.ceil(MIN_CELL_M / resolution_m - 1e-9))
    columns, rows = -(-width // merged), -(-height // merged)
    occupied_from = occupied_above * white
    free = bytearray(columns * rows)
    darkness = [value if negate else white - value for value in range(white + 1)]
    for top in range(height):
        row = (height - 1 - top) // merged
        line = pixels[top * width : (top + 1) * width]
        for column in range(columns):
            index = row * columns + column
            # 2: occupied for good
            if free[index] != 2:
                values = [darkness[value] for value in line[column * merged : (column + 1) * merged]]
                free[index] = 2 if max(values) > occupied_from else 1 if min(values) < limit else free[index]
    cells = bytes(value & 1 for value in free)
    return OccupancyMap((origin[0], origin[1]), resolution_m * merged, columns, rows, cells)


def read_pgm(path: Path) -> tuple[list[int] | bytes, int, int, int]:
    """Pixels from the upper left, width, height and white of a PGM image (netpbm's pgm(5), P2 or P5).

    Raises InvalidInput with file and line.
    """
    try:
        raw = path.read_bytes()
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from error
    head: list[int] = []
    at = 2
    if raw[:2] not in (b"P5", b"P2"):
        raise _problem(path, 1, "a PGM image (P5 or P2)", repr(raw[:2].decode("latin-1")))
    token = re.compile(rb"(?:\s|#[^\n]*\n)*([0-9]+)")
    while len(head) < 3:
        found = token.match(raw, at)
        if found is None:
            line = raw[:at].count(b"\n") + 1
            raise _problem(path, line, ("width", "height", "the value of white")[len(head)], "no number")
        head.append(int(found[1]))
        at = found.end()
    width, height, white = head
    line = raw[:at].count(b"\n") + 1
    if not (width and height and width * height <= MAX_PIXELS):
        raise _problem(path, line, f"1 to {MAX_PIXELS} pixels", f"{width} x {height}")
    if not 1 <= white <= 255:
        raise _problem(path, line, "a white of 1 to 255", str(white))
    if raw[:2] == b"P2":
        values = [int(word) for word in re.findall(rb"[0-9]+", re.sub(rb"#[^\n]*", b"", raw[at:]))]
    else:
        values = list(raw[at + 1 : at + 1 + width * height])
    if len(values) < width * height:
        raise _problem(path, line, f"{width * height} pixels", f"{len(values)}: the file is cut off")
    if max(values) > white:
        raise _problem(path, line, f"pixels of at most {white}", str(max(values)))
    return values[: width * height], width, height, white


def _problem(path: Path, line: int, expected: str, found: str) -> InvalidInput:
    place = Position(str(path), line, 1)
    diagnostic: Diagnostic = codes.error(codes.WRONG_VALUE, place, "", expected=expected, found=found)
    return InvalidInput([diagnostic])
