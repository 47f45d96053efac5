"""The thin links of a simulated team: one medium for each, beside the radio mesh, and how far budgets were used."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import Any

from udp_mesh.sim.event_queue import SimEventQueue
from udp_mesh.sim.mobility import Trajectory
from udp_mesh.sim.thin_medium import ThinMedium
from udp_mesh.sim.thin_scenario import ThinRadio

Deliver = Callable[[str, str, bytes], None]
"""(robot, thin link, frame)."""


class ThinMedia:
    """The media by link; `deliver` gets what arrives at a robot."""

    def __init__(
        self,
        event_queue: SimEventQueue,
        radios: Iterable[ThinRadio],
        robots: Mapping[str, Trajectory],
        deliver: Deliver,
        rng: random.Random,
    ) -> None:
        def loss(radio: ThinRadio, a: str, b: str, now: float) -> float:
            return radio.air.loss(robots[a].at(now), robots[b].at(now))

        def arrive(link: str, robot: str, frame: bytes) -> None:
            deliver(robot, link, frame)

        self.media = {
            radio.link.name: ThinMedium(
                event_queue, radio.link, robots, partial(loss, radio), partial(arrive, radio.link.name), rng
            )
            for radio in radios
        }

    def send(self, robot: str, link: str, frame: bytes) -> bool:
        """Send a frame; False if the link is none of these."""
        medium = self.media.get(link)
        if medium is not None:
            medium.send(robot, frame)
        return medium is not None

    def summary(self) -> dict[str, Any]:
        """Per link: frames, airtime by robot, and the largest share of its budget that a robot used in any window."""
        return {name: _summary(medium) for name, medium in self.media.items()}


def _summary(medium: ThinMedium) -> dict[str, Any]:
    link, counts = medium.link, medium.counts
    budget_s = link.duty_cycle * link.window_s
    busiest_s = max((busiest_window_s(medium, name) for name in counts.airtime_s), default=0.0)
    return {
        "frames": counts.sent.total(),
        "bytes": counts.bytes,
        "delivered": counts.delivered,
        "collided": counts.collided,
        "lost": counts.lost,
        "airtime_s": {name: round(seconds, 3) for name, seconds in counts.airtime_s.items()},
        "budget_s": budget_s,
        "budget_share": busiest_s / budget_s,
    }


def busiest_window_s(medium: ThinMedium, robot: str) -> float:
    """The largest airtime of a robot in any interval of the budget's window; a frame that lies partly in it counts
    whole."""
    sent = [(at, airtime_s) for at, name, airtime_s in medium.sent if name == robot]
    most, first, total_s = 0.0, 0, 0.0
    for at, airtime_s in sent:
        total_s += airtime_s
        while sent[first][0] + sent[first][1] <= at + airtime_s - medium.link.window_s:
            total_s -= sent[first][1]
            first += 1
        most = max(most, total_s)
    return most
