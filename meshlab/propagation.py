"""The ground a lab's fleet stands on: where its nodes are, what stands between them, and so who hears whom how well.

places and walls -> `received_dbm` (log-distance path loss) -> `frame_loss` -> `links_of`: one LinkSpec per pair that
hears each other in at least one direction. Links given by hand replace what the places would make of them.

Everything here is a function of values; `ground_file` reads and writes them. A moment of a moving fleet is one Ground.
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
"""Metres."""

# what a radio loses more than this of is not heard: batman-adv makes nothing of such a link
DEAF_LOSS = 0.9
# losses are told in hundredths: who moves a little need not be configured anew
_LOSS_DIGITS = 2
# antennas do not stand inside each other; also where the path-loss model begins
_MIN_DISTANCE_M = 1.0
_LIGHT_M_S = 299_792_458.0


@dataclass(frozen=True, slots=True)
class Wall:
    """A straight piece of rock: each one between two radios takes `loss_db` away. The default lets nothing through."""

    a: Point
    b: Point
    loss_db: float = 100.0


@dataclass(frozen=True, slots=True)
class PathLossModel:
    """How strength falls with distance, and loss grows as strength falls.

    `exponent` is 2 in free space, 1.6-1.8 along a corridor, 2.7-5 outdoors, 4-6 through buildings (Rappaport, Wireless
    Communications, table 4.2). `sensitivity_dbm` is the strength at which a tenth of the frames is lost, as IEEE
    802.11 defines a receiver's sensitivity; chips reach about -88 dBm at 12 Mbit/s. `fading_db` stands for everything
    that makes the edge soft: so many dB less multiply the odds of losing a frame by e.
    """

    tx_power_dbm: float = 24.0
    antenna_gain_dbi: float = 2.0
    frequency_mhz: float = 2437.0
    exponent: float = 3.5
    sensitivity_dbm: float = -88.0
    fading_db: float = 2.0


@dataclass(frozen=True, slots=True)
class NodePosition:
    """Where a node stands, and what it sends with (None: as `Air` says)."""

    at: Point
    tx_power_dbm: float | None = None


@dataclass(frozen=True, slots=True)
class RadioEnvironment:
    """`places` by node name; `links` are those given by hand, each pair at most once."""

    positions: Mapping[str, NodePosition] = field(default_factory=lambda: MappingProxyType({}))
    walls: tuple[Wall, ...] = ()
    path_loss: PathLossModel = PathLossModel()
    links: tuple[LinkSpec, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """Every node that is mentioned, sorted."""
        return tuple(sorted({*self.positions, *(name for link in self.links for name in link.ends)}))

    def with_moved(self, name: str, to: Point) -> RadioEnvironment:
        """The same ground with a node elsewhere. Raises InputError for a node that has no place."""
        if name not in self.positions:
            places = ", ".join(self.positions)
            raise InputError(
                f"{name} has no place on this ground, so it cannot move",
                hint=f"these have: {places}" if places else "`meshctl lab ground FILE` with `nodes:` gives places",
            )
        return replace(self, positions={**self.positions, name: replace(self.positions[name], at=to)})


def received_dbm(model: PathLossModel, distance_m: float, tx_power_dbm: float, walls_db: float = 0.0) -> float:
    """How strong a radio hears another: both antennas' gain, free space for the first metre, then the exponent.

    Source: the log-distance model, Rappaport, Wireless Communications, section 4.9.1.
    """
    first_metre_db = 20 * math.log10(4 * math.pi * model.frequency_mhz * 1e6 / _LIGHT_M_S)
    beyond_db = 10 * model.exponent * math.log10(max(distance_m, _MIN_DISTANCE_M))
    return tx_power_dbm + 2 * model.antenna_gain_dbi - first_metre_db - beyond_db - walls_db


def frame_loss(model: PathLossModel, strength_dbm: float) -> float:
    """The share (0..1) of frames lost at this strength: a tenth at the sensitivity; in hundredths, 1.0 for deafness."""
    margin = (strength_dbm - model.sensitivity_dbm) / model.fading_db
    # beyond this the share is 0 or 1 to more digits than are told
    loss = 1.0 / (1.0 + 9.0 * math.exp(max(-50.0, min(50.0, margin))))
    return 1.0 if loss >= DEAF_LOSS else round(loss, _LOSS_DIGITS)


def wall_loss_db(walls: tuple[Wall, ...], a: Point, b: Point) -> float:
    """What the walls on the straight line between two places take away, in dB."""
    return sum(wall.loss_db for wall in walls if _cross(a, b, wall.a, wall.b))


def links_of(environment: RadioEnvironment) -> tuple[LinkSpec, ...]:
    """Who hears whom: every pair of which at least one hears the other, by name; and the links given by hand."""
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
    """Whether the pieces a-b and c-d properly cross."""
    return _side(a, b, c) * _side(a, b, d) < 0 and _side(c, d, a) * _side(c, d, b) < 0
