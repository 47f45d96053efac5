"""`meshctl plan-placement`: where beacons keep a margin along a route, before the run."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path
from typing import Annotated, Any

import typer

from meshctl.cli.context import AsJson
from meshctl.cli.output import echo, echo_json, write_file
from meshctl.errors import ExitCode, InputError
from meshctl.placement.margin import UNMEASURED_FADE_DB
from meshctl.placement.path_loss import PathLossModel, Point, RadioModel, Wall
from meshctl.placement.picture import MapView, png, summary, svg
from meshctl.placement.planner import MappedTerrain, PlacementPlan, Terrain, Walls, plan

VERSION = 1
_WALL_DB = 12.0


def plan_placement(
    map_file: Annotated[
        Path,
        typer.Argument(metavar="MAP", help="A ground file of the lab, or the YAML file of a ROS map_server map."),
    ],
    route: Annotated[
        list[str],
        typer.Argument(metavar="POINT", help="The route from the base: nodes of the file, or X,Y in meters."),
    ],
    margin: Annotated[
        float, typer.Option("--margin", metavar="DB", help="Margin to keep everywhere on the route.")
    ] = UNMEASURED_FADE_DB,
    beacons: Annotated[int | None, typer.Option("--beacons", min=0, help="At most this many beacons.")] = None,
    wall_loss: Annotated[
        float,
        typer.Option("--wall-loss", min=0.0, metavar="DB", help="Loss of each wall of an occupancy map."),
    ] = _WALL_DB,
    exponent: Annotated[
        float | None, typer.Option("--exponent", min=1.0, max=10.0, help="Path-loss exponent of an occupancy map.")
    ] = None,
    tx_power: Annotated[float | None, typer.Option("--tx-power", metavar="DBM", help="Transmit power.")] = None,
    svg_file: Annotated[Path | None, typer.Option("--svg", metavar="FILE", help="Write a picture.")] = None,
    png_file: Annotated[Path | None, typer.Option("--png", metavar="FILE", help="Write a picture.")] = None,
    as_csv: Annotated[bool, typer.Option("--csv", help="Print CSV.")] = False,
    as_json: AsJson = False,
) -> None:
    """Plan the fewest beacons that keep a margin along a route.

    The route begins at the base. On an occupancy map, the way between two points leads through free space.

    Exit code: 0 the whole route has the margin, 1 part of it does not, 2 could not run.

    Example: meshctl plan-placement ground.yaml base 240,0 240,-60 --svg plan.svg

    Example: meshctl plan-placement mine.yaml 0,0 55,12 --beacons 4 --json
    """
    terrain, air, stops, view, inputs = _read(map_file, route, wall_loss, exponent)
    found = plan(terrain, air, stops, margin_db=margin, beacons=beacons, tx_power_dbm=tx_power)
    if svg_file is not None:
        write_file(svg_file, svg(view, found), inputs=inputs)
    if png_file is not None:
        write_file(png_file, png(view, found), inputs=inputs)
    if as_json:
        echo_json(json.dumps(_json(found), indent=2))
    elif as_csv:
        echo(_csv(found), nl=False)
    else:
        echo(_text(found))
    raise typer.Exit(ExitCode.OK if found.is_complete else ExitCode.FINDINGS)


def _read(
    map_file: Path, route: list[str], wall_loss: float, exponent: float | None
) -> tuple[Terrain, RadioModel, tuple[Point, ...], MapView, tuple[Path, ...]]:
    """The terrain, the model, the route, what to draw, and the files that were read."""
    # both need the inventory's YAML reader, which takes a tenth of the start-up
    from meshctl.inventory.yaml_entries import read
    from meshctl.placement import ground, occupancy_map

    if len(route) < 2:
        raise InputError("expected a route of two points at least: the base and the end")
    root = read(map_file)
    if occupancy_map.is_map(root):
        occupancy = occupancy_map.read_map(root, map_file)
        stops = occupancy.way(tuple(_point(word, {}) for word in route))
        model = PathLossModel() if exponent is None else PathLossModel(exponent=exponent)
        wall = Wall(stops[0], stops[0], loss_db=wall_loss)
        files = (map_file, map_file.parent / root.mapping()["image"].text())
        return MappedTerrain(occupancy, wall), model, stops, MapView(occupancy=occupancy), files
    found = ground.load(map_file)
    air = found.air
    if exponent is not None:
        raise InputError(f"--exponent: set air.exponent in {map_file}")
    stops = tuple(_point(word, {name: placed.at for name, placed in found.positions.items()}) for word in route)
    return Walls(found.walls), air, stops, MapView(walls=found.walls), (map_file,)


def _point(word: str, nodes: dict[str, Point]) -> Point:
    if word in nodes:
        return nodes[word]
    parts = word.split(",")
    try:
        x, y = (float(part) for part in parts)
    except ValueError:
        names = f" or one of {', '.join(nodes)}" if nodes else ""
        raise InputError(f"route: expected X,Y in meters{names}, found {word!r}") from None
    if not (abs(x) < 1e7 and abs(y) < 1e7):
        raise InputError(f"route: expected X,Y within 10,000 km, found {word!r}")
    return (x, y)


def _json(found: PlacementPlan) -> dict[str, Any]:
    return {
        "version": VERSION,
        "length_m": round(found.length_m, 1),
        "covered_m": round(found.covered_m, 1),
        "complete": found.is_complete,
        "margin_db": found.margin_db,
        "beacons": [
            {
                "number": number,
                "depth_m": round(beacon.depth_m, 1),
                "x_m": round(beacon.at[0], 2),
                "y_m": round(beacon.at[1], 2),
                "margin_db": round(beacon.margin_db, 1),
            }
            for number, beacon in enumerate(found.beacons, 1)
        ],
    }


def _csv(found: PlacementPlan) -> str:
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(["number", "depth_m", "x_m", "y_m", "margin_db"])
    writer.writerows([list(beacon.values()) for beacon in _json(found)["beacons"]])
    return out.getvalue()


def _text(found: PlacementPlan) -> str:
    lines = [f"{'beacon':>6}  {'depth, m':>8}  {'x, m':>8}  {'y, m':>8}  {'margin, dB':>10}"]
    lines += [
        f"{number:>6}  {beacon.depth_m:>8.0f}  {beacon.at[0]:>8.1f}  {beacon.at[1]:>8.1f}  {beacon.margin_db:>10.0f}"
        for number, beacon in enumerate(found.beacons, 1)
    ]
    rows = lines if found.beacons else ["no beacon is needed"] if found.is_complete else []
    if not found.is_complete:
        x, y = next(at for depth, at, _ in found.steps if depth >= found.covered_m)
        rows = [*rows, f"the margin ends at {found.covered_m:.0f} m ({x:.1f}, {y:.1f})"]
    return "\n".join([*rows, summary(found)])
