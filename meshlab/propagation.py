"""Radio propagation: node positions and walls -> signal strength -> frame loss -> links.

positions, walls -> `received_dbm` (log-distance path loss) -> `frame_loss` -> `links_of`: one LinkSpec for each pair of
which at least one hears the other. Explicit links replace the computed ones.

Pure; `propagation_file` reads and writes the files. A moving fleet is a sequence of `RadioEnvironment`s.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import combinations
from types import MappingProxyType

from meshctl.errors import InputError
from meshlab.spec import LinkSpec

Point = tuple[float, float]
"""x and y in meters."""

# above this loss there is no link: batman-adv would not use it
DEAF_LOSS = 0.9
# losses are rounded to hundredths, so that a small move does not change the links
_LOSS_DIGITS = 2
# the path-loss model's reference distance
_MIN_DISTANCE_M = 1.0
_LIGHT_M_S = 299_792_458.0


@dataclass(frozen=True, slots=True)
class Wall:
    """A wall that attenuates every signal through it by `loss_db`. The default blocks it."""

    a: Point
    b: Point
    loss_db: float = 100.0


@dataclass(frozen=True, slots=True)
class PathLossModel:
    """Log-distance path loss, and frame loss as a function of the received power.

    `exponent` is 2 in free space, 1.6-1.8 along a corridor, 2.7-5 outdoors, 4-6 through buildings (Rappaport, Wireless
    Communications, table 4.2). `sensitivity_dbm` is the power at which 10 % of the frames are lost, as IEEE 802.11
    defines receiver sensitivity; chips reach about -88 dBm at 12 Mbit/s. `fading_db` is the slope of the transition:
    that many dB less multiply the odds of losing a frame by e.
    """

    tx_power_dbm: float = 24.0
    antenna_gain_dbi: float = 2.0
    frequency_mhz: float = 2437.0
    exponent: float = 3.5
    sensitivity_dbm: float = -88.0
    fading_db: float = 2.0


@dataclass(frozen=True, slots=True)
class NodePosition:
    """A node's position and transmit power (None: the model's)."""

    at: Point
    tx_power_dbm: float | None = None


@dataclass(frozen=True, slots=True)
class RadioEnvironment:
    """`positions` by node name; `links` are the explicit ones, each pair at most once."""

    positions: Mapping[str, NodePosition] = field(default_factory=lambda: MappingProxyType({}))
    walls: tuple[Wall, ...] = ()
    path_loss: PathLossModel = PathLossModel()
    links: tuple[LinkSpec, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """Every node with a position or an explicit link, sorted."""
        return tuple(sorted({*self.positions, *(name for link in self.links for name in link.ends)}))

    def with_moved(self, name: str, to: Point) -> RadioEnvironment:
        """The same environment with a node moved. Raises InputError for a node without a position."""
        if name not in self.positions:
            places = ", ".join(self.positions)
            raise InputError(
                f"cannot move {name}: it has no position",
                hint=f"nodes with a position: {places}" if places else "load positions with `meshctl lab ground FILE`",
            )
        return replace(self, positions={**self.positions, name: replace(self.positions[name], at=to)})


def received_dbm(model: PathLossModel, distance_m: float, tx_power_dbm: float, walls_db: float = 0.0) -> float:
    """Received power: both antennas' gain, free space for the first meter, then the path-loss exponent.

    Source: the log-distance model, Rappaport, Wireless Communications, section 4.9.1.
    """
    first_meter_db = 20 * math.log10(4 * math.pi * model.frequency_mhz * 1e6 / _LIGHT_M_S)
    beyond_db = 10 * model.exponent * math.log10(max(distance_m, _MIN_DISTANCE_M))
    return tx_power_dbm + 2 * model.antenna_gain_dbi - first_meter_db - beyond_db - walls_db


def frame_loss(model: PathLossModel, strength_dbm: float) -> float:
    """The share (0..1) of frames lost at this power: 0.1 at the sensitivity; in hundredths, 1.0 above `DEAF_LOSS`."""
    margin = (strength_dbm - model.sensitivity_dbm) / model.fading_db
    # clamped: beyond this the rounded share is 0 or 1 anyway
    loss = 1.0 / (1.0 + 9.0 * math.exp(max(-50.0, min(50.0, margin))))
    return 1.0 if loss >= DEAF_LOSS else round(loss, _LOSS_DIGITS)


def wall_loss_db(walls: tuple[Wall, ...], a: Point, b: Point) -> float:
    """The attenuation of the walls on the straight line between two points, in dB."""
    return sum(wall.loss_db for wall in walls if _cross(a, b, wall.a, wall.b))


def links_of(environment: RadioEnvironment) -> tuple[LinkSpec, ...]:
    """A link for each pair of which at least one hears the other, sorted by name; then the explicit links."""
    explicit = {link.ends for link in environment.links}
    found = [
        link
        for a, b in combinations(sorted(environment.positions), 2)
        if frozenset((a, b)) not in explicit and (link := _link(environment, a, b)) is not None
    ]
    return (*found, *environment.links)


def _link(environment: RadioEnvironment, a: str, b: str) -> LinkSpec | None:
    first, second, model = environment.positions[a], environment.positions[b], environment.path_loss
    distance_m = math.dist(first.at, second.at)
    walls_db = wall_loss_db(environment.walls, first.at, second.at)
    strengths = [
        received_dbm(model, distance_m, model.tx_power_dbm if own is None else own, walls_db)
        for own in (first.tx_power_dbm, second.tx_power_dbm)
    ]
    there, back = (frame_loss(model, strength) for strength in strengths)
    if there >= 1.0 and back >= 1.0:
        return None
    return LinkSpec(
        a,
        b,
        signal_dbm=round(strengths[0]),
        loss=there,
        loss_back=None if back == there else back,
        signal_back_dbm=None if strengths[0] == strengths[1] else round(strengths[1]),
    )


def _side(a: Point, b: Point, c: Point) -> float:
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


def _cross(a: Point, b: Point, c: Point, d: Point) -> bool:
    """Whether the segments a-b and c-d properly cross."""
    return _side(a, b, c) * _side(a, b, d) < 0 and _side(c, d, a) * _side(c, d, b) < 0
