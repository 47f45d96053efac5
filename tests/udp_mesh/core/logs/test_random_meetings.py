"""Whatever the meetings, crashes and losses: once a path of meetings existed, every item has arrived exactly once."""

from __future__ import annotations

import random

import pytest

from tests.udp_mesh.core.logs.team import LogTeam

ROBOTS = ("base", "husky", "drone", "spot", "walker")


def play(seed: int) -> LogTeam:
    """Random meetings of two or three nodes, with loss, slow links and restarts; then everybody meets Husky."""
    rng = random.Random(seed)
    team = LogTeam(*ROBOTS, seed=seed)
    for pipe in team.pipes.values():
        pipe.loss = rng.choice((0.0, 0.05, 0.2))
        pipe.rate_bits_per_s = rng.choice((1e6, 5e6, 20e6))
        pipe.delay_s = rng.choice((0.002, 0.02))
    published = 0
    for _ in range(6):
        for _ in range(rng.randint(0, 4)):
            published += 1
            source = rng.choice(ROBOTS[1:])
            team.publish(source, source.encode() + b" %d " % published + rng.randbytes(rng.choice((20, 2_000, 60_000))))
        team.meet(*rng.sample(ROBOTS, rng.randint(2, 3)), seconds=rng.uniform(1.5, 6), apart_s=rng.choice((1, 12)))
        if rng.random() < 0.3:
            name = rng.choice(ROBOTS)
            team.stop(name)
            team.start(name)
            team.separate()
    for name in ("spot", "drone", "walker", "base"):
        team.meet("husky", name, seconds=12)
    return team


def check(team: LogTeam) -> None:
    """Every item of every robot is at the base, once."""
    published = {
        (item.log.source, item.number)
        for name, store in team.stores.items()
        for item in store.items
        if item.log.source == name
    }
    read = [(source, number) for source, number, _ in team.read("base")]
    assert sorted(read) == sorted(published)
    assert all(payload.startswith(source.encode()) for source, _, payload in team.read("base"))


@pytest.mark.parametrize("seed", range(6))
def test_every_item_arrives_exactly_once(seed: int) -> None:
    check(play(seed))


@pytest.mark.proof
@pytest.mark.timeout(7200)
def test_every_item_arrives_exactly_once_in_a_thousand_teams() -> None:
    for seed in range(1000):
        try:
            check(play(seed))
        except AssertionError as error:
            raise AssertionError(f"seed {seed}: {error}") from error
