"""A scenario says what robots' programs read; robots then send that and no more."""

from __future__ import annotations

import pytest

from udp_mesh.core.subscriptions.messages import Bounds, Subscription
from udp_mesh.sim.run import play
from udp_mesh.sim.scenario import ScenarioError, parse

SCENARIO = """
duration_s: 30
robots: {base: [0, 0], rover: [10, 0], uav: [20, 0]}
topics:
  map: {priority: 8}
  video: {priority: 9, reliable: false, keep_last: 1}
  stop: {priority: 0}
  kept: {priority: 8, always: true}
flows:
  - {topic: map, sources: [rover], period_s: 1, size_bytes: 5000, start_s: 8}
  - {topic: video, sources: [rover], period_s: 0.1, size_bytes: 5000, start_s: 8}
  - {topic: stop, sources: [base], period_s: 2, size_bytes: 20, start_s: 8}
  - {topic: kept, sources: [rover], period_s: 2, size_bytes: 3000, start_s: 8}
incidents: [{at_s: 20, what: crash, who: uav}, {at_s: 21, what: restart, who: uav}]
"""
READS = """
reads:
  base: {map: {}, video: {rate_hz: 1, max_age_s: 2}}
  uav: [nothing]
  rover: [nothing]
"""


def test_what_robots_read_is_taken_from_the_scenario() -> None:
    assert parse(SCENARIO.encode(), "s.yaml").reads == {}
    assert parse((SCENARIO + READS).encode(), "s.yaml").reads == {
        "base": (Subscription("map"), Subscription("video", Bounds(1.0, 2.0))),
        "uav": (Subscription("nothing"),),
        "rover": (Subscription("nothing"),),
    }


@pytest.mark.parametrize(
    ("reads", "problem"),
    [
        ("{hase: [map]}", "hase"),
        ("{base: {map: {rate: 1}}}", "rate_hz"),
        ("{base: {map: {rate_hz: 0}}}", "at least 0.001"),
        ("{base: {map: {max_age_s: soon}}}", "reads.base.map.max_age_s"),
        ("{base: 5}", "reads.base"),
    ],
)
def test_faulty_reads_are_reported_with_their_line(reads: str, problem: str) -> None:
    with pytest.raises(ScenarioError) as found:
        parse((SCENARIO + f"reads: {reads}\n").encode(), "s.yaml")
    line = len(SCENARIO.splitlines()) + 1
    assert f"s.yaml:{line}: " in str(found.value)
    assert problem in str(found.value)


def test_robots_send_what_is_read_and_the_summary_says_what_was_saved() -> None:
    everything, selective = (play(parse(text.encode(), "s.yaml")) for text in (SCENARIO, SCENARIO + READS))
    assert selective.counts.airtime_s < 0.5 * everything.counts.airtime_s
    offered, arrived = selective.offered, {name: total.messages for name, total in selective.topics.items()}
    # At the base; the restarted uav is sent everything for a few seconds.
    assert offered["map"] - 1 <= selective.observer_bytes["map"] / 5000 <= offered["map"]
    assert 20 <= selective.observer_bytes["video"] / 5000 <= 25
    assert arrived["stop"] >= 2 * offered["stop"] - 2
    assert arrived["kept"] >= 2 * offered["kept"] - 2
    assert everything.summary()["saved"] == {"messages": 0, "bytes": 0}
    saved = selective.summary()["saved"]
    assert saved["messages"] > 300
    assert saved["bytes"] == 5000 * saved["messages"]
    assert not selective.ledger.ended_twice
