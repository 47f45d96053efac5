"""Whatever happens to links, nodes, disks and programs, the promises of `promises` hold."""

from __future__ import annotations

import pytest

from tests.udp_mesh.core.busy_teams import BusyTeam
from tests.udp_mesh.core.hostile_teams import HostileTeam
from tests.udp_mesh.core.promises import play


@pytest.mark.parametrize("seed", [0, 1, 4, 6, 7, 8, 10])
def test_every_promise_is_kept_whatever_happens(seed: int) -> None:
    play(seed, 8.0)


@pytest.mark.parametrize("seed", [3, 4, 7])
def test_every_promise_is_kept_by_hostile_networks(seed: int) -> None:
    play(seed, 8.0, HostileTeam)


@pytest.mark.parametrize("seed", [0, 1, 2, 15])
def test_every_promise_is_kept_by_busy_computers(seed: int) -> None:
    play(seed, 6.0, BusyTeam)


def test_a_boot_that_is_first_heard_over_an_unplugged_link_gets_what_waits() -> None:
    """Its datagram was on its way when the link went, so it had no path until it was heard over the other one."""
    play(255, 20.0)


@pytest.mark.proof
@pytest.mark.timeout(4 * 3600)
def test_every_promise_is_kept_in_three_thousand_teams() -> None:
    for seed in range(3000):
        try:
            play(seed, 20.0)
        except AssertionError as error:
            raise AssertionError(f"seed {seed}: {error}") from error


@pytest.mark.proof
@pytest.mark.timeout(4 * 3600)
def test_every_promise_is_kept_by_a_thousand_hostile_networks() -> None:
    for seed in range(1000):
        try:
            play(seed, 20.0, HostileTeam)
        except AssertionError as error:
            raise AssertionError(f"seed {seed}: {error}") from error


@pytest.mark.proof
@pytest.mark.timeout(4 * 3600)
def test_every_promise_is_kept_by_a_thousand_busy_teams() -> None:
    for seed in range(1000):
        try:
            play(seed, 20.0, BusyTeam)
        except AssertionError as error:
            raise AssertionError(f"seed {seed}: {error}") from error


@pytest.mark.proof
@pytest.mark.timeout(4 * 3600)
@pytest.mark.parametrize("seed", range(100, 120))
def test_every_promise_is_kept_for_two_minutes(seed: int) -> None:
    play(seed, 120.0)
