"""Spot never meets the base, and Husky meets each for five seconds: every artifact arrives exactly once."""

from __future__ import annotations

import random

import pytest

from tests.udp_mesh.core.logs.team import LogTeam

MEETING_S = 5.0
MAX_ARTIFACTS, MAX_BYTES = 4, 60_000
"""Between two meetings: at 2 Mbit/s they take one second."""


def publish(team: LogTeam, rng: random.Random, payloads: list[bytes]) -> None:
    """A new artifact of Spot's."""
    size = rng.choice((20, 2_000, MAX_BYTES))
    payloads.append(b"artifact %d " % len(payloads) + rng.randbytes(size))
    team.publish("spot", payloads[-1])


def play(seed: int) -> tuple[LogTeam, list[bytes]]:
    """Meetings in random order with random times between them, with loss, slow links and restarts.

    Carriers leave links alone that lose much more than these.
    After the last artifact, Husky meets Spot once and then the base once, for five seconds each.
    """
    rng = random.Random(seed)
    team = LogTeam("base", "husky", "spot", seed=seed)
    for pipe in team.pipes.values():
        pipe.loss = rng.choice((0.0, 0.02, 0.05))
        pipe.rate_bits_per_s = rng.choice((2e6, 6e6, 20e6))
        pipe.delay_s = rng.choice((0.002, 0.02))
    payloads: list[bytes] = []
    meetings = [*rng.choices(("spot", "base"), k=rng.randint(0, 6)), "spot", "base"]
    for number, other in enumerate(meetings, 1):
        for _ in range(rng.randint(0, MAX_ARTIFACTS) if number < len(meetings) else 0):
            publish(team, rng, payloads)
        team.run(rng.uniform(0, 3))
        team.meet("husky", other, seconds=MEETING_S, apart_s=rng.choice((8, 12, 40)))
        if rng.random() < 0.2:
            name = rng.choice(("base", "husky", "spot"))
            team.stop(name)
            team.start(name)
            team.separate()
    return team, payloads


def check(team: LogTeam, payloads: list[bytes]) -> None:
    """Each artifact was read at the base once."""
    assert sorted(payload for _, _, payload in team.read("base")) == sorted(payloads)
    for pipe in (team.pipes["spot", "base"], team.pipes["base", "spot"]):
        assert pipe.dropped == pipe.carried, "they never met"


@pytest.mark.parametrize("seed", range(6))
def test_every_artifact_arrives_exactly_once(seed: int) -> None:
    check(*play(seed))


def test_an_absence_does_not_make_the_link_weak() -> None:
    """Husky, which only carries, took nothing for the eight seconds after it: longer than they meet."""
    team = LogTeam("base", "husky", "spot")
    team.meet("husky", "spot", seconds=12, apart_s=8)
    team.connect("husky", "spot")
    team.run(1.5)
    team.publish("spot", b"backpack")
    team.run(MEETING_S - 1.5)
    assert len(team.stores["husky"].items) == 1


@pytest.mark.proof
@pytest.mark.timeout(7200)
def test_every_artifact_arrives_exactly_once_with_a_thousand_seeds() -> None:
    for seed in range(1000):
        try:
            check(*play(seed))
        except AssertionError as error:
            raise AssertionError(f"seed {seed}: {error}") from error
