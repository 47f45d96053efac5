"""A map for radio planning: node positions, walls and a propagation model, read from YAML.

    nodes: {base: [0, 0], b01: {at: [80, 0], tx_power_dbm: 33}}      # meters
    walls: [{a: [40, 10], b: [200, 10], loss_db: 40}]
    air: {exponent: 3.5}             # keys of `PathLossModel`; with `model: subt`, those of `SubtModel`

The lab's files of positions and links have the same three keys; docs/lab-ground.md describes them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from types import MappingProxyType
from typing import Any

from meshctl.inventory.yaml_entries import YamlEntry, parse_text, read
from meshctl.placement.path_loss import PathLossModel, Point, RadioModel, SubtModel, Wall

GROUND_KEYS = ("nodes", "walls", "air")

# the plausible range of each number of the two models
_BOUNDS = {
    "tx_power_dbm": (-20.0, 60.0),
    "antenna_gain_dbi": (-20.0, 40.0),
    "frequency_mhz": (100.0, 100_000.0),
    "exponent": (1.0, 10.0),
    "sensitivity_dbm": (-150.0, 0.0),
    "fading_db": (0.1, 30.0),
    "noise_dbm": (-150.0, 0.0),
    "reference_loss_db": (0.0, 120.0),
    "exponent_per_cost": (0.0, 5.0),
    "max_cost": (0.0, 1000.0),
    "max_range_m": (1.0, 100_000.0),
    "sigma_db": (0.0, 30.0),
}
STANDARD_AIR = PathLossModel()
_MODELS: dict[str, type[PathLossModel | SubtModel]] = {"log-distance": PathLossModel, "subt": SubtModel}


@dataclass(frozen=True, slots=True)
class NodePosition:
    """A node's position and transmit power (None: the model's)."""

    at: Point
    tx_power_dbm: float | None = None


@dataclass(frozen=True, slots=True)
class Ground:
    """`positions` by node name."""

    positions: Mapping[str, NodePosition] = field(default_factory=lambda: MappingProxyType({}))
    walls: tuple[Wall, ...] = ()
    air: RadioModel = STANDARD_AIR


def load(path: Path) -> Ground:
    """Read a ground file; `links` of the lab's files are ignored, because they do not depend on positions.

    Raises InvalidInput with every problem found, each with file, line and column.
    """
    return _ground(read(path))


def parse(text: str, file: str) -> Ground:
    """Like `load`, from the file's text; `file` is the file name in problems."""
    return _ground(parse_text(text, file))


def _ground(root: YamlEntry) -> Ground:
    if root.has("meshctl"):
        root.problem("a map: a file with nodes, walls or air", "an inventory")
        root.finish()
    ground = ground_in(root.mapping((*GROUND_KEYS, "links")))
    if not root.is_present:
        root.problem("a mapping")
    root.finish()
    return ground


def ground_in(keys: Mapping[str, YamlEntry]) -> Ground:
    """The ground of the entries `nodes`, `walls` and `air`, which collect the problems."""
    positions = {name: _position(entry) for name, entry in keys["nodes"].mapping().items()}
    return Ground(positions, tuple(_wall(entry) for entry in keys["walls"].items()), _air(keys["air"]))


def air_json(air: RadioModel) -> dict[str, Any]:
    """The model as the file's entry `air`."""
    assert isinstance(air, PathLossModel | SubtModel)
    values = asdict(air)
    return {"model": "subt", **values} if isinstance(air, SubtModel) else values


def _position(entry: YamlEntry) -> NodePosition:
    """`[x, y]`, or `{at: [x, y], tx_power_dbm: 33}`."""
    if entry.is_list:
        return NodePosition(entry.point())
    keys = entry.mapping(("at", "tx_power_dbm"), required=("at",))
    power = keys["tx_power_dbm"]
    minimum, maximum = _BOUNDS["tx_power_dbm"]
    return NodePosition(
        keys["at"].point() if keys["at"].is_present else (0.0, 0.0),
        power.number(0.0, minimum, maximum) if power.is_present else None,
    )


def _wall(entry: YamlEntry) -> Wall:
    keys = entry.mapping(("a", "b", "loss_db", "visibility_cost"), required=("a", "b"))
    ends = [keys[end].point() if keys[end].is_present else (0.0, 0.0) for end in ("a", "b")]
    standard = Wall(ends[0], ends[1])
    return Wall(
        ends[0],
        ends[1],
        keys["loss_db"].number(standard.loss_db, 0.0, 1000.0),
        keys["visibility_cost"].number(standard.visibility_cost, 0.0, 1000.0),
    )


def _air(entry: YamlEntry) -> PathLossModel | SubtModel:
    given = entry.mapping() if entry.is_present else {}
    chosen = given["model"].text() if "model" in given else "log-distance"
    kind = _MODELS.get(chosen)
    if kind is None:
        given["model"].problem(f"one of {', '.join(_MODELS)}", repr(chosen))
        kind = PathLossModel
    names = tuple(item.name for item in fields(kind))
    keys = entry.mapping((*names, "model"))
    standard = asdict(kind())
    return kind(**{name: keys[name].number(standard[name], *_BOUNDS[name]) for name in names})
