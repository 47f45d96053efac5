"""Fixed positions of radios and robots (MC641 to MC643)."""

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
# a single node so many times as far away as can be is at a wrong position; otherwise the distance may be too short
_MISPLACED = 4


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
        if _apart_m(place, there) <= MAX_LINK_M:
            return True
        other += step
    return False


@fleet_rule(
    "MC643",
    Severity.WARNING,
    "Nodes of a mesh are farther apart than its longest link",
    why="""`distance_m` is the length of the longest link: radios wait for an acknowledgment as long as it takes over
    this distance. Over a longer link each frame is sent again until it is given up, although it arrived. Either the
    distance is too short, or a position is wrong. Nodes without a position may stand in between; each of them is
    counted as another link.""",
    fix="Correct the position, or set `distance_m` of the mesh to the length of the longest link.",
    failing="""
    nodes: {b01: {position: {x_m: 10, y_m: 20}}, base: {position: {x_m: 40000, y_m: 20}}}
    """,
    passing="""
    nodes: {b01: {position: {x_m: 10, y_m: 20}}, base: {position: {x_m: 1800, y_m: 20}}}
    """,
)
def apart_for_distance(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for mesh in fleet.meshes.values():
        members = [node for node in fleet.managed() if mesh.name in node.meshes]
        placed = [(node.name, node.position) for node in members if node.position is not None]
        reach_m = mesh.distance_m * (len(members) - len(placed) + 1)
        gaps = _gaps(placed, reach_m) if mesh.distance_m else []
        for gap_m, cluster, (near, far) in gaps:
            is_misplaced = len(cluster) == 1 < len(placed) - 1 and gap_m > _MISPLACED * reach_m
            if gap_m > MAX_LINK_M and len(cluster) == 1:
                continue  # MC642 reports it
            path = ("nodes", cluster[0], "position") if is_misplaced else ("meshes", mesh.name, "distance_m")
            message = f"{near} and {far} are {gap_m / 1000:.1f} km apart, and no other node is between them"
            if len(members) > len(placed):
                message = f"{near} and {far} are {gap_m / 1000:.1f} km apart, too far for the nodes without a position"
            yield Finding(path, message, f"links of at most distance_m of mesh {mesh.name}", f"{mesh.distance_m} m")
            if not is_misplaced:
                break  # the distance is too short for all of them


_Placed = list[tuple[str, FixedPosition]]


def _gaps(placed: _Placed, reach_m: float) -> list[tuple[float, list[str], tuple[str, str]]]:
    """The clusters of nodes within reach of each other, but for the largest: the distance to the nearest other
    cluster, the nodes, and the two nodes nearest to each other; the widest gap first."""
    clusters = sorted(_clusters(placed, reach_m), key=len)
    if len(clusters) < 2:
        return []
    # by x, so that each is compared with its surroundings alone
    ordered = sorted(placed, key=lambda item: item[1].x_m)
    place_of = {name: place for place, (name, _) in enumerate(ordered)}
    found = []
    for cluster in clusters[:-1]:
        inside = {name for name, _ in cluster}
        gap_m, near, far = min(_nearest(ordered, place_of[name], inside) for name, _ in cluster)
        found.append((gap_m, [name for name, _ in cluster], (near, far)))
    return sorted(found, reverse=True)


def _clusters(placed: _Placed, reach_m: float) -> list[_Placed]:
    """The nodes that are connected by links of at most `reach_m`, looked for in squares of that size."""
    squares: dict[tuple[int, int], dict[str, FixedPosition]] = {}
    for name, place in placed:
        squares.setdefault(_square(place, reach_m), {})[name] = place
    number = {name: place for place, (name, _) in enumerate(placed)}
    clusters, taken = [], set[str]()
    for first in reversed(placed):
        if first[0] in taken:
            continue
        taken.add(first[0])
        del squares[_square(first[1], reach_m)][first[0]]
        cluster = [first]
        # grows while it is read
        for _, place in cluster:
            column, row = _square(place, reach_m)
            within = [
                (name, there)
                for x in (column - 1, column, column + 1)
                for y in (row - 1, row, row + 1)
                for name, there in squares.get((x, y), {}).items()
                if _apart_m(place, there) <= reach_m
            ]
            for name, there in within:
                taken.add(name)
                del squares[_square(there, reach_m)][name]
            cluster += sorted(within, key=lambda item: number[item[0]])
        clusters.append(cluster)
    return clusters


def _square(place: FixedPosition, size_m: float) -> tuple[int, int]:
    return math.floor(place.x_m / size_m), math.floor(place.y_m / size_m)


def _nearest(ordered: _Placed, index: int, inside: set[str]) -> tuple[float, str, str]:
    """The distance to the nearest node that is not `inside`, this node, and that one."""
    name, place = ordered[index]
    best = (math.inf, name, "")
    for step in (-1, 1):
        other = index + step
        while 0 <= other < len(ordered) and abs(ordered[other][1].x_m - place.x_m) <= best[0]:
            far, there = ordered[other]
            if far not in inside:
                best = min(best, (_apart_m(place, there), name, far))
            other += step
    return best


def _apart_m(place: FixedPosition, there: FixedPosition) -> float:
    return math.hypot(there.x_m - place.x_m, there.y_m - place.y_m)
