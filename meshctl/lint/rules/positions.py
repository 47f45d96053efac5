"""Fixed positions of radios and robots (MC641 to MC642)."""

from __future__ import annotations

import math
from collections.abc import Iterator

from meshctl.diagnostics import Severity
from meshctl.lint.context import LintContext
from meshctl.lint.grouping import group_by_key
from meshctl.lint.rule import Finding, fleet_rule
from meshctl.model import FixedPosition, Fleet
from meshctl.wording import join_limited

# Directional links of hundreds of kilometers exist as records; a mesh's are shorter than this.
MAX_LINK_M = 100_000.0


def _nodes(fleet: Fleet) -> dict[str, FixedPosition]:
    return {node.name: node.position for node in fleet.managed() if node.position is not None}


@fleet_rule(
    "MC641",
    Severity.WARNING,
    "Several nodes have the same position",
    why="""Two radios are never at one place: an entry was copied, or the position is in a group or in `defaults`. A
    drawn map and the distances between nodes would be wrong. Radios of one robot may share a position.""",
    fix="Write each node's own position at the node.",
    failing="""
    nodes:
      b01: {position: {x_m: 10, y_m: 20}}
      base: {position: {x_m: 10, y_m: 20}}
    """,
    passing="""
    nodes:
      b01: {position: {x_m: 10, y_m: 20}}
      base: {position: {x_m: 10, y_m: 60}}
    """,
)
def same_position(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    at = group_by_key(((place.x_m, place.y_m, place.z_m), name) for name, place in _nodes(fleet).items())
    for (x_m, y_m, _), names in at.items():
        owners = {fleet.nodes[name].robot or name for name in names}
        if len(owners) > 1:
            path = ("nodes", names[-1], "position")
            yield Finding(
                path, f"{join_limited(names)} stand at one place", "a place of its own", f"({x_m:g}, {y_m:g})"
            )


@fleet_rule(
    "MC642",
    Severity.WARNING,
    "A node is out of reach of all others by its position",
    why="""Positions are meters in one frame. A node that is more than 100 km from every other one was probably written
    in another unit or another frame, or as degrees.""",
    fix="Write x_m and y_m in meters from the origin that the other nodes use.",
    failing="""
    nodes:
      b01: {position: {x_m: 10, y_m: 20}}
      base: {position: {x_m: 447000, y_m: 20}}
    """,
    passing="""
    nodes:
      b01: {position: {x_m: 10, y_m: 20}}
      base: {position: {x_m: 447, y_m: 20}}
    """,
)
def far_position(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    placed = _nodes(fleet)
    # by x, so that each is compared with its surroundings alone
    ordered = sorted(placed.items(), key=lambda item: (item[1].x_m, item[1].y_m))
    for index, (name, place) in enumerate(ordered):
        if len(ordered) > 1 and not any(_reaches(ordered, index, step, place) for step in (-1, 1)):
            found = f"({place.x_m:g}, {place.y_m:g})"
            message = f"{name} is more than {MAX_LINK_M / 1000:g} km from every other node with a position"
            yield Finding(("nodes", name, "position"), message, "meters in the frame of the others", found)


def _reaches(ordered: list[tuple[str, FixedPosition]], index: int, step: int, place: FixedPosition) -> bool:
    """Whether a node in this direction of the order is near enough."""
    other = index + step
    while 0 <= other < len(ordered):
        there = ordered[other][1]
        if abs(there.x_m - place.x_m) > MAX_LINK_M:
            return False
        if math.hypot(there.x_m - place.x_m, there.y_m - place.y_m) <= MAX_LINK_M:
            return True
        other += step
    return False
