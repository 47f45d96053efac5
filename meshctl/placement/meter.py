"""The placement meter: measured links of a robot that carries beacons -> how far it may go before it drops one. Pure.

`Meter.step` takes one `LinkSnapshot` (all links of the robot's radio at one moment) and returns a `Reading`:

1. The margin of each relay in reach is the worse of its link's margin and the bottleneck of its path to the base.
2. The slope of the next hop's signal per driven meter gives the meters that are left.
3. DROP SOON below 15 m, DROP NOW below 5 m or with a negative margin, TURN BACK without a link, until the last place
   with a margin. Another relay in reach with more than 10 dB vetoes a drop.

docs/placement.md derives the figures.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum

from meshctl.placement.margin import (
    UNMEASURED_FADE_DB,
    Sample,
    fade_allowance_db,
    filtered_snr_db,
    fresh_snr_db,
    path_rate_mbit_s,
    rate_mbit_s,
    slope_db_per_m,
    worse_snr_db,
)

SOON_M = 15.0
NOW_M = 5.0
VETO_DB = 10.0
STEEP_DB = 20.0
"""Above this margin the slope gives no advice: next to a relay the signal falls steeply, but ever less so."""
COLLAPSE_DB = -2.0
"""Below this margin a beacon would hang on a bad link: it belongs to the last place with a margin."""
TURN_RAD = math.radians(20.0)
TURN_WINDOW_M = 6.0
BEHIND_TURN_M = 8.0
FIRST_TURN_LOSS_DB = 20.0
"""Assumed loss of a bend until the first one has been measured: typical of a rock corner at 2.4 and 5 GHz."""
SLOPE_WINDOW_M = 20.0
MIN_SLOPE_M = 5.0
LOST_S = 2.0
"""Without a link to a relay that reaches the base for this long, the robot is lost."""
_KEPT_S = 30.0
_KEPT_SAMPLES = 600
_MAX_STEP_M = 50.0
"""A longer way between two positions is a jump of the odometry, and is not driven."""

Position = tuple[float, float, float]


class Advice(Enum):
    """The advice to the operator; the value is the displayed text."""

    GO = "GO"
    DROP_SOON = "DROP SOON"
    DROP_NOW = "DROP NOW"
    TURN_BACK = "TURN BACK"


@dataclass(frozen=True, slots=True)
class RelayLink:
    """One relay as the robot's radio hears it, and (`back_dbm`) as the relay hears the robot; None is unknown."""

    relay: str
    signal_dbm: float
    noise_dbm: float | None = None
    back_dbm: float | None = None
    back_noise_dbm: float | None = None


@dataclass(frozen=True, slots=True)
class PathBeyond:
    """The way from a relay to the base: its hops (0 for the base itself), and the least margin and ratio of signal to
    noise over them (None: unknown or no hop)."""

    hops: int
    margin_db: float | None = None
    snr_db: float | None = None


@dataclass(frozen=True, slots=True)
class LinkSnapshot:
    """The robot's links at one moment. `paths` has every relay that reaches the base; `next_hop` is the routing
    protocol's choice, if known; `beacons` is how many the robot still carries."""

    now_s: float
    links: tuple[RelayLink, ...]
    paths: Mapping[str, PathBeyond]
    position: Position | None = None
    next_hop: str = ""
    heading_rad: float | None = None
    beacons: int | None = None
    spacing_m: float | None = None
    """The usual distance between two beacons here, for the depth that the stock allows."""


@dataclass(frozen=True, slots=True)
class Reading:
    """The meter at one moment; unknown values are None. `last_good` is the last place with a margin, `back_m` the way
    back to it."""

    now_s: float
    advice: Advice
    reason: str
    margin_db: float | None = None
    next_hop: str = ""
    snr_db: float | None = None
    fade_db: float | None = None
    bottleneck_db: float | None = None
    hops: int | None = None
    rate_mbit_s: float | None = None
    """About what the path carries: the least hop's rate over the hops that share its channel."""
    slope_db_per_m: float | None = None
    meters_left: float | None = None
    last_good: Position | None = None
    back_m: float | None = None
    turn_loss_db: float = FIRST_TURN_LOSS_DB
    """The loss at bends of this mine so far."""
    beacons: int | None = None
    depth_left_m: float | None = None
    """How much deeper the stock of beacons carries: the meters left plus one spacing for each beacon."""


@dataclass(frozen=True, slots=True)
class _Hop:
    relay: str
    snr_db: float
    fade_db: float
    link_margin_db: float
    path_margin_db: float
    fresh_db: float
    """The excess of the last two samples over the needed ratio, without allowance."""
    hops: int
    least_snr_db: float


@dataclass(frozen=True, slots=True)
class _Turn:
    """A bend that the robot drives through, with the link of the moment."""

    relay: str
    snr_db: float
    at_m: float


@dataclass(slots=True)
class Meter:
    """The state of one robot's meter. `required_snr_db` is what the offered load needs (`margin.required_snr_db`)."""

    required_snr_db: float
    _samples: dict[str, deque[Sample]] = field(default_factory=dict)
    _driven_m: float = 0.0
    _position: Position | None = None
    _last_good: Position | None = None
    _good_fade_db: float = UNMEASURED_FADE_DB
    _headings: deque[tuple[float, float]] = field(default_factory=deque)
    _turn: _Turn | None = None
    _turn_losses_db: list[float] = field(default_factory=list)
    _heard_s: float | None = None
    _is_returning: bool = False

    def step(self, snapshot: LinkSnapshot) -> Reading:
        """The reading after this snapshot. Snapshots come in ascending order of time."""
        self._drive(snapshot.position)
        self._take(snapshot)
        hops = {hop.relay: hop for hop in self._hops(snapshot)}
        if not hops:
            return self._without_link(snapshot)
        self._heard_s = max(self._samples[relay][-1].at_s for relay in hops)
        self._measure_turn(snapshot, hops)
        best = max(hops.values(), key=lambda hop: (hop.path_margin_db, hop.relay))
        hop = hops.get(snapshot.next_hop, best)
        other_db = max((other.link_margin_db for other in hops.values() if other is not hop), default=-math.inf)
        slope = slope_db_per_m(tuple(self._samples[hop.relay]), SLOPE_WINDOW_M, MIN_SLOPE_M)
        left_m = _meters_left(hop.link_margin_db, slope)
        if max(hop.link_margin_db, other_db) >= 0.0 and not self._is_returning:
            self._last_good, self._good_fade_db = self._position, min(hop.fade_db, UNMEASURED_FADE_DB)
        if max(hop.link_margin_db, other_db) > VETO_DB:
            self._is_returning = False
        advice, reason = self._judge(snapshot, hop, other_db, left_m)
        return Reading(
            snapshot.now_s,
            advice,
            reason,
            margin_db=hop.link_margin_db,
            next_hop=hop.relay,
            snr_db=hop.snr_db,
            fade_db=hop.fade_db,
            bottleneck_db=hop.path_margin_db,
            hops=hop.hops,
            rate_mbit_s=path_rate_mbit_s(rate_mbit_s(hop.least_snr_db), hop.hops),
            slope_db_per_m=slope,
            meters_left=left_m,
            last_good=self._last_good,
            back_m=self._back_m(),
            turn_loss_db=self._turn_loss_db(),
            beacons=snapshot.beacons,
            depth_left_m=_depth_left_m(left_m, snapshot),
        )

    def _drive(self, position: Position | None) -> None:
        if position is not None and self._position is not None:
            step_m = math.dist(position, self._position)
            self._driven_m += step_m if step_m <= _MAX_STEP_M else 0.0
        self._position = position if position is not None else self._position

    def _take(self, snapshot: LinkSnapshot) -> None:
        for link in snapshot.links:
            snr_db = worse_snr_db(link.signal_dbm, link.noise_dbm, link.back_dbm, link.back_noise_dbm)
            kept = self._samples.setdefault(link.relay, deque(maxlen=_KEPT_SAMPLES))
            kept.append(Sample(snapshot.now_s, snr_db, self._driven_m))
        for relay, kept in list(self._samples.items()):
            while kept and snapshot.now_s - kept[0].at_s > _KEPT_S:
                kept.popleft()
            if not kept:
                del self._samples[relay]

    def _is_turning(self, snapshot: LinkSnapshot) -> bool:
        """Whether the heading has changed within the last meters; a turn counts once."""
        if snapshot.heading_rad is None:
            return False
        while self._headings and self._driven_m - self._headings[0][0] > TURN_WINDOW_M:
            self._headings.popleft()
        turned = any(abs(math.remainder(snapshot.heading_rad - old, math.tau)) > TURN_RAD for _, old in self._headings)
        if turned:
            self._headings.clear()
        self._headings.append((self._driven_m, snapshot.heading_rad))
        return turned

    def _measure_turn(self, snapshot: LinkSnapshot, hops: Mapping[str, _Hop]) -> None:
        """Learn what a bend costs from the link that the robot had in it, as soon as it is behind it."""
        turn = self._turn
        if turn is None:
            return
        hop = hops.get(turn.relay)
        if hop is None:
            # at least what it had
            self._turn_losses_db.append(max(self._turn_loss_db(), turn.snr_db - self.required_snr_db))
            self._turn = None
        elif self._driven_m - turn.at_m >= BEHIND_TURN_M:
            self._turn_losses_db.append(max(0.0, turn.snr_db - hop.snr_db))
            self._turn = None

    def _turn_loss_db(self) -> float:
        losses = (FIRST_TURN_LOSS_DB, *self._turn_losses_db)
        return sum(losses) / len(losses)

    def _hops(self, snapshot: LinkSnapshot) -> list[_Hop]:
        """Every relay that was heard lately and reaches the base."""
        found = []
        for relay, beyond in snapshot.paths.items():
            samples = tuple(self._samples.get(relay, ()))
            if not samples or snapshot.now_s - samples[-1].at_s > LOST_S:
                continue
            snr_db, fade_db = filtered_snr_db(samples), fade_allowance_db(samples)
            link_db = snr_db - self.required_snr_db - fade_db
            fresh_db = fresh_snr_db(samples) - self.required_snr_db
            whole_db = link_db if beyond.margin_db is None else min(link_db, beyond.margin_db)
            least_db = snr_db if beyond.snr_db is None else min(snr_db, beyond.snr_db)
            found.append(_Hop(relay, snr_db, fade_db, link_db, whole_db, fresh_db, beyond.hops + 1, least_db))
        return found

    def _without_link(self, snapshot: LinkSnapshot) -> Reading:
        if self._heard_s is None:
            reason = "no relay that reaches the base has been heard yet"
        else:
            self._is_returning = True
            reason = f"no relay that reaches the base for {snapshot.now_s - self._heard_s:.0f} s"
        return Reading(
            snapshot.now_s,
            Advice.TURN_BACK,
            reason,
            last_good=self._last_good,
            back_m=self._back_m(),
            turn_loss_db=self._turn_loss_db(),
            beacons=snapshot.beacons,
        )

    def _back_m(self) -> float | None:
        """The straight way back to the last place with a margin."""
        if self._last_good is None or self._position is None:
            return None
        return math.dist(self._last_good, self._position)

    def _judge(self, snapshot: LinkSnapshot, hop: _Hop, other_db: float, left_m: float | None) -> tuple[Advice, str]:
        turns = self._is_turning(snapshot)
        if turns and not self._is_returning:
            self._turn = _Turn(hop.relay, hop.snr_db, self._driven_m)
            if max(hop.link_margin_db, other_db) < self._turn_loss_db():
                return self._drop(
                    snapshot, Advice.DROP_NOW, f"a bend: bends cost about {self._turn_loss_db():.0f} dB here"
                )
        if other_db > VETO_DB:
            return Advice.GO, f"another relay is in reach with {other_db:.0f} dB"
        # the allowance of the last 10 s still has the fall in it
        if self._is_returning and hop.fresh_db >= self._good_fade_db:
            return self._drop(snapshot, Advice.DROP_NOW, "back at a place with a margin")
        if hop.link_margin_db < COLLAPSE_DB and self._last_good is not None:
            self._is_returning = True
        if self._is_returning:
            what = "no beacon left" if snapshot.beacons == 0 else "place the beacon at the last place with one"
            return Advice.TURN_BACK, f"no margin: {what}"
        if hop.link_margin_db < 0.0:
            return self._drop(snapshot, Advice.DROP_NOW, "no margin left")
        if hop.link_margin_db > STEEP_DB:
            left_m = None
        if left_m is not None and left_m < NOW_M:
            return self._drop(snapshot, Advice.DROP_NOW, f"{left_m:.0f} m left")
        if left_m is not None and left_m < SOON_M:
            return self._drop(snapshot, Advice.DROP_SOON, f"{left_m:.0f} m left")
        if hop.path_margin_db < 0.0:
            return Advice.GO, f"a hop behind {hop.relay} has {hop.path_margin_db:.0f} dB: a beacon is missing there"
        return Advice.GO, ""

    def _drop(self, snapshot: LinkSnapshot, advice: Advice, reason: str) -> tuple[Advice, str]:
        if snapshot.beacons == 0:
            return Advice.TURN_BACK if advice is Advice.DROP_NOW else advice, f"{reason}, and no beacon left"
        return advice, reason


def _meters_left(margin_db: float, slope: float | None) -> float | None:
    """How far the margin lasts at this slope; None if it does not fall, or the slope is unknown."""
    if slope is None or slope >= 0.0:
        return None
    return max(0.0, margin_db) / -slope


def _depth_left_m(left_m: float | None, snapshot: LinkSnapshot) -> float | None:
    if snapshot.beacons is None or snapshot.spacing_m is None:
        return None
    return (left_m or 0.0) + snapshot.beacons * snapshot.spacing_m
