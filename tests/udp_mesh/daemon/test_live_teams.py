"""Real daemons on a hostile network keep the promises of `live.promises`, whatever happens to them."""

from __future__ import annotations

import subprocess
import sys

import pytest

pytestmark = pytest.mark.xdist_group("udp_mesh_live")


def play(first: int, last: int, *, seconds: float) -> None:
    command = [sys.executable, "-m", "tests.udp_mesh.daemon.live.promises", str(first), str(last)]
    done = subprocess.run([*command, "--seconds", str(seconds)], check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr


def test_promises_are_kept_on_a_hostile_network() -> None:
    play(0, 2, seconds=4.0)


@pytest.mark.proof
@pytest.mark.timeout(8 * 3600)
def test_promises_are_kept_by_two_hundred_teams() -> None:
    play(0, 200, seconds=20.0)


@pytest.mark.proof
@pytest.mark.timeout(2 * 3600)
def test_promises_are_kept_for_ten_minutes() -> None:
    play(1000, 1004, seconds=600.0)
