"""Missions in which only a thin link reaches some robots: the stop arrives, once, and no budget is exceeded."""

from __future__ import annotations

from dataclasses import replace

import pytest

from udp_mesh.sim.command import SHIPPED, text
from udp_mesh.sim.run import RunResult, play
from udp_mesh.sim.scenario import Scenario, ScenarioError, load, parse
from udp_mesh.sim.thin_scenario import ThinRadios

ROBOTS_WITHOUT_WIFI = 2


def scenario(seed: int = 5) -> Scenario:
    return replace(load(SHIPPED / "thin-stop.yaml"), seed=seed)


def stops(result: RunResult) -> tuple[int, int]:
    """How many were sent, and how many arrived at all robots together."""
    return result.offered["estop"], result.topics["estop"].messages


@pytest.mark.parametrize("seed", [5, 6, 7])
def test_the_thin_link_alone_delivers_every_stop_once_within_its_budget(seed: int) -> None:
    result = play(scenario(seed))
    offered, arrived = stops(result)
    assert offered > 5
    assert arrived == offered * ROBOTS_WITHOUT_WIFI
    assert max(result.topics["estop"].latencies_s) < 10
    [link] = result.summary()["thin"].values()
    assert 0 < link["budget_share"] < 1
    assert "of its 36 s of airtime" in text(result.summary())


def test_without_it_no_stop_arrives() -> None:
    without = replace(scenario(), thin=ThinRadios())
    offered, arrived = stops(play(without))
    assert offered > 5
    assert arrived == 0


def test_positions_still_arrive_at_the_base() -> None:
    with_thin, without = play(scenario()), play(replace(scenario(), thin=ThinRadios()))
    more = with_thin.observer_bytes["position"] - without.observer_bytes["position"]
    # Two robots for twenty minutes, a position of 24 bytes a minute each.
    assert more > 0.7 * 2 * 20 * 24


def test_the_same_seed_gives_the_same_run() -> None:
    short = replace(scenario(), duration_s=700.0)
    assert play(short).summary() == play(short).summary()


@pytest.mark.parametrize(
    ("thin", "message"),
    [
        ("links: {lora: {frame_bytes: 50}}", "thin.links.lora: expected the key bits_per_s"),
        ("links: {lora: {bits_per_s: 0}}", "thin.links.lora.bits_per_s: expected a number of at least 10"),
        ("links: {lora: {bits_per_s: 100, duty_cycle: 0.0001}}", "thin.links.lora: expected a thin link that can work"),
        ("link: {}", "did you mean 'links'?"),
    ],
)
def test_mistakes_are_reported(thin: str, message: str) -> None:
    raw = f"robots: {{a: [0, 0], b: [1, 1]}}\nthin: {{{thin}}}\n"
    with pytest.raises(ScenarioError) as caught:
        parse(raw.encode(), "s.yaml")
    assert message in str(caught.value)
