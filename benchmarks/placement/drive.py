"""One robot drives one law through one tunnel in virtual time: a second is a step, and a meter at most.

Every second each link passes or loses frames by the propagation model; the base's message of that second arrives if
every hop of the best path passes it within the transmissions of 802.11.
"""

from __future__ import annotations

import heapq
import math
import random
from collections.abc import Mapping
from dataclasses import dataclass

from benchmarks.placement.rules import BASE, Rule, View
from benchmarks.placement.tunnels import Tunnel
from meshctl.placement.margin import FADE_DEVIATIONS
from meshctl.placement.meter import PathBeyond
from meshctl.placement.path_loss import PathLossModel

FAST_FADING_DB = {True: 2.0 * math.pi / math.sqrt(3.0), False: math.sqrt(10.0)}
"""Standard deviation of one frame's power: that of the lab model's logistic slope of 2 dB, and DARPA's."""
TRANSMISSIONS = 7
"""Of one unicast frame (802.11's retry limit)."""
FRAMES_PER_S = 5
"""Frames of a relay from which the radio can tell its signal."""
GIVES_UP_S = 30
"""Without beacons and without the base for this long, the run ends."""
MAX_S = 8000


@dataclass(frozen=True, slots=True)
class Second:
    """One second of a run."""

    depth_m: float
    connected: bool
    beacons: int


def drive(tunnel: Tunnel, rule: Rule, beacons: int, seed: int) -> list[Second]:
    """The whole run; `seed` decides what frames are lost."""
    rng = random.Random(f"drive-{tunnel.seed}-{seed}")
    sigma_db = FAST_FADING_DB[isinstance(tunnel.air, PathLossModel)]
    relays = {BASE: 0.0}
    depth_m, left, out_s = 1.0, beacons, 0
    run: list[Second] = []
    backbone = _backbone(tunnel, relays, sigma_db)
    while len(run) < MAX_S:
        powers = {relay: tunnel.power_dbm(at, depth_m) for relay, at in relays.items()}
        losses = {relay: tunnel.air.loss(power) for relay, power in powers.items()}
        passes = [_delivery(losses[relay]) * path.delivery for relay, path in backbone.items()]
        connected = rng.random() < max(passes, default=0.0)
        rssi = {
            relay: round(power + rng.gauss(0.0, sigma_db))
            for relay, power in powers.items()
            if losses[relay] < 1.0 and rng.random() < 1.0 - losses[relay] ** FRAMES_PER_S
        }
        view = View(
            float(len(run)),
            tunnel.at(depth_m),
            tunnel.heading(depth_m),
            connected,
            rssi,
            {relay: tunnel.at(at) for relay, at in relays.items()},
            {relay: PathBeyond(path.hops, path.margin_db) for relay, path in backbone.items()},
            any(abs(depth_m - junction) < 1.0 for junction in tunnel.junctions_m),
            left,
            tunnel.air.noise_dbm,
            tunnel.air.required_snr_db,
        )
        action = rule.step(view)
        if action.drop and left:
            relays[len(relays)] = depth_m
            left -= 1
            backbone = _backbone(tunnel, relays, sigma_db)
        run.append(Second(depth_m, connected, left))
        out_s = 0 if connected else out_s + 1
        depth_m = max(1.0, depth_m + action.move)
        if depth_m >= tunnel.length_m or (out_s >= GIVES_UP_S and action.move == 1):
            break
    return run


@dataclass(frozen=True, slots=True)
class _Path:
    delivery: float
    hops: int
    margin_db: float | None


def _delivery(loss: float) -> float:
    return 1.0 - loss**TRANSMISSIONS


def _backbone(tunnel: Tunnel, relays: Mapping[int, float], sigma_db: float) -> dict[int, _Path]:
    """The best path of every relay to the base: the greatest chance that a message passes."""
    found: dict[int, _Path] = {}
    queue: list[tuple[float, int, int, float]] = [(-1.0, 0, BASE, math.inf)]
    while queue:
        chance, hops, relay, margin_db = heapq.heappop(queue)
        if relay in found:
            continue
        found[relay] = _Path(-chance, hops, None if margin_db == math.inf else margin_db)
        for other, at in relays.items():
            if other in found:
                continue
            power = tunnel.power_dbm(relays[relay], at)
            loss = tunnel.air.loss(power)
            if loss < 1.0:
                needed = tunnel.air.noise_dbm + tunnel.air.required_snr_db + FADE_DEVIATIONS * sigma_db
                heapq.heappush(queue, (chance * _delivery(loss), hops + 1, other, min(margin_db, power - needed)))
    return found


def reach_m(run: list[Second], outage: float) -> float:
    """The deepest place that the robot reported from, while at most this share of the seconds until then was without
    the base."""
    deepest, lost = 0.0, 0
    for count, second in enumerate(run, 1):
        lost += not second.connected
        if second.connected and lost <= outage * count:
            deepest = max(deepest, second.depth_m)
    return deepest
