"""A camera whose quality follows its link: real transport cores on a simulated channel, in virtual time.

The sizes of images are a model; the budget is the transport's: a map and telemetry share the link, and for a while a
more urgent lidar takes most of it.
"""

from __future__ import annotations

import random
import statistics
from dataclasses import dataclass, field
from itertools import pairwise

import pytest

from udp_mesh.bridges.reduction import JpegOptions, Reducer, Reduction
from udp_mesh.core.events import Event, MessageDelivered, MessageExpired, MessageId
from udp_mesh.core.settings import Settings, Topic
from udp_mesh.sim.medium import RadioChannel
from udp_mesh.sim.team import Team

PERIOD_S = 1.0
FINEST_BYTES, RATIO = 80_000, 10.0
"""An image at full detail, and how much smaller it is at none."""
TOPICS = (
    Topic("telemetry", priority=3, reliable=False),
    Topic("lidar", priority=5, reliable=False),
    Topic("camera", priority=9, keep_last=1),
    Topic("map", priority=12, keep_last=1),
)


@dataclass
class Run:
    """What the base got: (time, detail) of every image that was sent, and the latencies of those that arrived."""

    details: list[tuple[float, float]] = field(default_factory=list)
    latencies: list[tuple[float, float]] = field(default_factory=list)

    def share_delivered(self, start_s: float, end_s: float) -> float:
        sent = sum(start_s <= at < end_s for at, _ in self.details)
        return sum(start_s <= at < end_s for at, _ in self.latencies) / sent

    def details_in(self, start_s: float, end_s: float) -> list[float]:
        return [detail for at, detail in self.details if start_s <= at < end_s]

    def median_latency_s(self, start_s: float, end_s: float) -> float:
        return statistics.median(latency_s for at, latency_s in self.latencies if start_s <= at < end_s)

    def turns(self, start_s: float, end_s: float) -> int:
        """How often the detail changed its direction."""
        values = self.details_in(start_s, end_s)
        changes = [later - sooner for sooner, later in pairwise(values) if later != sooner]
        return sum((sooner > 0) != (later > 0) for sooner, later in pairwise(changes))


LINK_BIT_S = 3e6
BUSY_S, END_S = (40.0, 120.0), 180.0
"""When the lidar sends."""


def drive(*, adapt: bool, seed: int) -> Run:
    run, sent_at = Run(), dict[MessageId, float]()
    reducer = Reducer({"camera": Reduction(1 / PERIOD_S, JpegOptions(60, 10), adapt=adapt)}, 1)

    def note(now: float, robot: str, event: Event) -> None:
        if robot != "rover" or not isinstance(event, MessageDelivered | MessageExpired):
            return
        started = sent_at.pop(event.message_id, None)
        if started is None:
            return
        if isinstance(event, MessageDelivered):
            run.latencies.append((started, event.latency_s))
            reducer.on_outcome("camera", event.peer, "delivered", event.latency_s, now)
        else:
            reducer.on_outcome("camera", event.peer, "expired", None, now)

    settings = {name: Settings(name, unkeyed=True, topics=TOPICS) for name in ("rover", "base")}
    team = Team(settings, channel=RadioChannel(rate=LINK_BIT_S), loss=lambda a, b, now: 0.02, seed=seed, on_event=note)
    rng = random.Random(seed)
    team.event_queue.run_until(5.0)
    for number in range(round((END_S - 5.0) * 10)):
        now = 5.0 + number / 10
        team.event_queue.run_until(now)
        team.send("rover", "telemetry", bytes(300), "base")
        if BUSY_S[0] <= now < BUSY_S[1]:
            team.send("rover", "lidar", rng.randbytes(24_000), "base")
        if number % 50 == 0:
            team.send("rover", "map", rng.randbytes(100_000), "base")
        if number % 10 == 0:
            detail = reducer.detail("camera")
            size = FINEST_BYTES * RATIO ** (detail - 1) * rng.uniform(0.9, 1.1)
            run.details.append((now, detail))
            message = team.send("rover", "camera", rng.randbytes(round(size)), "base")
            assert isinstance(message, int)
            sent_at[message] = now
    team.event_queue.run_until(END_S + 5.0)
    return run


@pytest.mark.parametrize("seed", [1, 2])
def test_quality_follows_the_budget_and_settles(seed: int) -> None:
    adapted, fixed = (drive(adapt=adapt, seed=seed) for adapt in (True, False))
    quiet, busy, quiet_again = (15.0, BUSY_S[0]), (60.0, BUSY_S[1]), (150.0, END_S)
    for window in (quiet, busy, quiet_again):
        assert adapted.share_delivered(*window) > 0.95
        assert adapted.median_latency_s(*window) < PERIOD_S
        assert adapted.turns(*window) <= 1
    assert set(adapted.details_in(*quiet)) == set(adapted.details_in(*quiet_again)) == {1.0}
    assert 0.0 < max(adapted.details_in(*busy)) < 0.9
    # a camera that does not adapt sends images that arrive late, or never
    assert fixed.median_latency_s(*busy) > PERIOD_S
    assert fixed.share_delivered(*busy) < adapted.share_delivered(*busy)
