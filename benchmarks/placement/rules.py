"""Laws that decide where to drop a beacon, once a second, from what a robot knows at that moment.

`Bobcat` and `Ladder` are rules that other teams published, written down from their description; `Threshold` is the
ladder's idea with the next hop instead of the base; `ByMeter` follows `meshctl.placement.meter`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

from meshctl.placement.meter import Advice, LinkSnapshot, Meter, PathBeyond, RelayLink
from meshctl.placement.path_loss import Point

BASE = 0
"""The base among the relays, which are numbered in the order in which they were dropped."""


@dataclass(frozen=True, slots=True)
class View:
    """What the robot knows. `heard`: the base's message of this second arrived; `rssi_dbm` by relay; `relays` are their
    places; `paths` are the relays that reach the base."""

    now_s: float
    at: Point
    heading: float
    heard: bool
    rssi_dbm: Mapping[int, float]
    relays: Mapping[int, Point]
    paths: Mapping[int, PathBeyond]
    at_junction: bool
    beacons: int
    noise_dbm: float
    required_snr_db: float


class Action(NamedTuple):
    """`move` is 1 onward, -1 back, 0 stay."""

    move: int = 1
    drop: bool = False


class Rule(Protocol):
    def step(self, view: View) -> Action: ...


@dataclass
class Bobcat:
    """The beacon monitor of dan-riley/bobcat (`src/monitors.py`): geometry, and driving back once out of reach.

    `anchor_m` and `drop_m` are its `anchorDropDist` and `dropDist`.
    """

    anchor_m: float
    drop_m: float
    redeploy_m: float = 4.0
    _history: list[tuple[Point, float]] = field(default_factory=list)
    _heard_s: float = 0.0
    _regained: int = 0
    _out: int = 0
    _lost_at: Point = (0.0, 0.0)
    _is_back: bool = False
    _tried: list[Point] = field(default_factory=list)

    def step(self, view: View) -> Action:
        self._history = [*self._history, (view.at, view.heading)][-10:]
        if view.heard:
            self._heard_s = view.now_s
        in_reach = view.now_s - self._heard_s <= 3.0
        self._regained = self._regained + 1 if in_reach and view.heard else self._regained if in_reach else 0
        if view.beacons == 0:
            return Action()
        if self._is_back:
            return self._return(view, in_reach)
        if not in_reach:
            return self._consider_return(view)
        self._out = 0
        return Action(drop=self._regained > 10 and self._drops_here(view))

    def _consider_return(self, view: View) -> Action:
        if not self._out:
            self._lost_at = view.at
        self._out += 1
        if self._out <= 10 or math.dist(view.at, self._lost_at) <= 3.0:
            return Action()
        self._out = 0
        if any(math.dist(view.at, tried) < self.redeploy_m for tried in self._tried):
            return Action()
        self._tried.append(view.at)
        self._is_back = True
        return Action(-1)

    def _return(self, view: View, in_reach: bool) -> Action:
        if not in_reach:
            return Action(-1)
        if self._regained <= 5:
            # it stops and counts messages
            return Action(0)
        self._is_back = False
        return Action(0, drop=not self._beacon_within(view, self.redeploy_m))

    def _drops_here(self, view: View) -> bool:
        anchor_m = math.dist(view.at, view.relays[BASE])
        if anchor_m < 10.0:
            return False
        if view.at_junction:
            return not self._beacon_within(view, 10.0)
        if self._turned():
            return not self._beacon_within(view, 15.0)
        if anchor_m > self.anchor_m:
            return not self._beacon_within(view, self.drop_m)
        return len(view.relays) > 1 and not self._beacon_within(view, self.anchor_m)

    def _turned(self) -> bool:
        if len(self._history) < 10:
            return False
        early, late = self._history[:4], self._history[6:]
        centers = [tuple(sum(at[axis] for at, _ in part) / 4 for axis in (0, 1)) for part in (early, late)]
        yaws = [math.atan2(sum(math.sin(yaw) for _, yaw in part), sum(math.cos(yaw) for _, yaw in part))
                for part in (early, late)]  # fmt: skip
        turn = abs(math.remainder(yaws[1] - yaws[0], 2 * math.pi))
        step_m = math.dist(self._history[-2][0], self._history[-1][0])
        return math.dist(*centers) > 4.0 and turn > math.radians(30.0) and step_m > 0.5

    def _beacon_within(self, view: View, radius_m: float) -> bool:
        return any(relay != BASE and math.dist(view.at, at) <= radius_m for relay, at in view.relays.items())


LADDER_DBM = (-55.0, -60.0, -65.0, -70.0, -75.0, -78.0, -80.0, -82.0, -84.0, -85.0, -86.0)


@dataclass
class Ladder:
    """arjo129/darpa_ugv_highlevel: one beacon at each step of the RSSI to the base."""

    _next: int = 0

    def step(self, view: View) -> Action:
        rssi_dbm = view.rssi_dbm.get(BASE)
        if rssi_dbm is None or self._next >= len(LADDER_DBM) or rssi_dbm > LADDER_DBM[self._next]:
            return Action()
        while self._next < len(LADDER_DBM) and rssi_dbm <= LADDER_DBM[self._next]:
            self._next += 1
        return Action(drop=True)


@dataclass
class Threshold:
    """A beacon whenever the strongest relay falls below a fixed RSSI: the simplest law that looks at the next hop."""

    rssi_dbm: float

    def step(self, view: View) -> Action:
        strongest = max(view.rssi_dbm.values(), default=None)
        return Action(drop=strongest is not None and strongest < self.rssi_dbm and view.heard)


@dataclass
class ByMeter:
    """An operator who does what the meter says."""

    _meter: Meter | None = None

    def step(self, view: View) -> Action:
        if self._meter is None:
            self._meter = Meter(view.required_snr_db)
        links = tuple(RelayLink(str(relay), dbm, view.noise_dbm) for relay, dbm in view.rssi_dbm.items())
        paths = {str(relay): path for relay, path in view.paths.items()}
        position = (view.at[0], view.at[1], 0.0)
        reading = self._meter.step(
            LinkSnapshot(view.now_s, links, paths, position, heading_rad=view.heading, beacons=view.beacons)
        )
        if view.beacons == 0:
            return Action()
        if reading.advice is Advice.TURN_BACK and reading.last_good is not None:
            return Action(-1)
        return Action(drop=reading.advice is Advice.DROP_NOW)
