"""Radio propagation: positions and walls -> received power -> share of lost frames.

Two models with the same interface (`RadioModel`): `PathLossModel`, log-distance with a loss per wall, and `SubtModel`,
the one of DARPA's Subterranean Challenge simulator, in which walls steepen the decay.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol

Point = tuple[float, float]
"""x and y in meters."""

# above this loss there is no link: batman-adv would not use it
DEAF_LOSS = 0.9
# losses are rounded to hundredths, so that a small move does not change the links
_LOSS_DIGITS = 2
# the path-loss model's reference distance
_MIN_DISTANCE_M = 1.0
_LIGHT_M_S = 299_792_458.0
# a full frame of Ethernet
_FRAME_BITS = 8 * 1500


@dataclass(frozen=True, slots=True)
class Wall:
    """A wall that attenuates every signal through it by `loss_db`. The default blocks it.

    `visibility_cost` is what the wall costs in `SubtModel`, whose own tables have costs between the tiles of a course.
    """

    a: Point
    b: Point
    loss_db: float = 100.0
    visibility_cost: float = 2.0


class RadioModel(Protocol):
    """Received power and frame loss. `tx_power_dbm` is that of nodes without their own; `required_snr_db` above
    `noise_dbm`, half of the frames are lost."""

    @property
    def tx_power_dbm(self) -> float: ...

    @property
    def noise_dbm(self) -> float: ...

    @property
    def required_snr_db(self) -> float: ...

    def power_dbm(self, distance_m: float, tx_power_dbm: float, walls: Sequence[Wall]) -> float:
        """The received power through these walls; -inf if nothing arrives."""
        ...

    def loss(self, strength_dbm: float) -> float:
        """The share (0..1) of frames lost at this power; in hundredths, 1.0 above `DEAF_LOSS`."""
        ...


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

    @property
    def noise_dbm(self) -> float:
        """The thermal noise of 20 MHz with a receiver's usual noise figure of 6 dB."""
        return -95.0

    @property
    def required_snr_db(self) -> float:
        return self.sensitivity_dbm - self.fading_db * math.log(9.0) - self.noise_dbm

    def power_dbm(self, distance_m: float, tx_power_dbm: float, walls: Sequence[Wall]) -> float:
        return received_dbm(self, distance_m, tx_power_dbm, sum(wall.loss_db for wall in walls))

    def loss(self, strength_dbm: float) -> float:
        return frame_loss(self, strength_dbm)


@dataclass(frozen=True, slots=True)
class SubtModel:
    """The communication model of DARPA's simulator (osrf/subt, `subt_ign/src/VisibilityRfModel.cc`).

    Path loss is `reference_loss_db + 10 n log10(meters)`; n is `exponent` plus `exponent_per_cost` for each unit of the
    walls' visibility cost, and nothing arrives beyond `max_cost` or `max_range_m`. Each packet's power varies by
    `sigma_db` (the simulator's `sigma` of 10 is used as a variance). QPSK: BER = erfc(sqrt(P / N)).
    """

    tx_power_dbm: float = 27.0
    noise_dbm: float = -90.0
    reference_loss_db: float = 40.0
    exponent: float = 2.5
    exponent_per_cost: float = 0.2
    max_cost: float = 15.0
    max_range_m: float = 500.0
    sigma_db: float = math.sqrt(10.0)

    @property
    def required_snr_db(self) -> float:
        """Where half of the full frames are lost."""
        return _subt_threshold_db()

    def power_dbm(self, distance_m: float, tx_power_dbm: float, walls: Sequence[Wall]) -> float:
        cost = sum(wall.visibility_cost for wall in walls)
        if cost > self.max_cost or distance_m > self.max_range_m:
            return -math.inf
        exponent = self.exponent + self.exponent_per_cost * cost
        decay_db = 10.0 * exponent * math.log10(max(distance_m, _MIN_DISTANCE_M))
        return tx_power_dbm - self.reference_loss_db - decay_db

    def loss(self, strength_dbm: float) -> float:
        """The mean over the packets' different powers."""
        if strength_dbm == -math.inf:
            return 1.0
        snr_db = strength_dbm - self.noise_dbm
        mean = sum(weight * packet_error(snr_db + offset * self.sigma_db) for offset, weight in _NORMAL)
        return 1.0 if mean >= DEAF_LOSS else round(mean, _LOSS_DIGITS)


def packet_error(snr_db: float, bits: int = _FRAME_BITS) -> float:
    """The share (0..1) of packets of this size that QPSK loses at this ratio of signal to noise."""
    bit_error = math.erfc(math.sqrt(10.0 ** (snr_db / 10.0)))
    return 1.0 if bit_error >= 1.0 else -math.expm1(bits * math.log1p(-bit_error))


@lru_cache(maxsize=1)
def _subt_threshold_db() -> float:
    low, high = -20.0, 30.0
    while high - low > 1e-6:
        middle = (low + high) / 2
        low, high = (middle, high) if packet_error(middle) > 0.5 else (low, middle)
    return high


def _normal_steps(count: int = 41, reach: float = 4.0) -> tuple[tuple[float, float], ...]:
    """Offsets in standard deviations and their weights."""
    offsets = [reach * (2 * index / (count - 1) - 1) for index in range(count)]
    weights = [math.exp(-offset * offset / 2) for offset in offsets]
    return tuple((offset, weight / sum(weights)) for offset, weight in zip(offsets, weights, strict=True))


_NORMAL = _normal_steps()


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


def walls_between(walls: Sequence[Wall], a: Point, b: Point, *, touching: bool = False) -> tuple[Wall, ...]:
    """The walls on the straight line between two points; `touching`: also walls in which one of the points lies."""
    left, right = min(a[0], b[0]), max(a[0], b[0])
    low, high = min(a[1], b[1]), max(a[1], b[1])
    return tuple(
        wall
        for wall in walls
        # most walls of a mine are elsewhere
        if min(wall.a[0], wall.b[0]) <= right
        and max(wall.a[0], wall.b[0]) >= left
        and min(wall.a[1], wall.b[1]) <= high
        and max(wall.a[1], wall.b[1]) >= low
        and (_cross(a, b, wall.a, wall.b) or (touching and _touch(a, b, wall.a, wall.b)))
    )


def _side(a: Point, b: Point, c: Point) -> float:
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


def _cross(a: Point, b: Point, c: Point, d: Point) -> bool:
    """Whether the segments a-b and c-d properly cross."""
    return _side(a, b, c) * _side(a, b, d) < 0 and _side(c, d, a) * _side(c, d, b) < 0


def _touch(a: Point, b: Point, c: Point, d: Point) -> bool:
    """Whether a or b lies on the segment c-d, and the other one does not lie on its line."""
    at_a, at_b = _side(c, d, a), _side(c, d, b)
    return (at_a == 0.0) != (at_b == 0.0) and _side(a, b, c) * _side(a, b, d) <= 0
