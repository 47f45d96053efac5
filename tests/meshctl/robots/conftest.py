"""A fleet of two robots on loopback, and wheels for them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.meshctl.robots.fleets import RobotFleet
from tests.meshctl.robots.wheels import repack


@pytest.fixture(scope="session")
def wheels(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return repack(tmp_path_factory.mktemp("wheels"))


@pytest.fixture
def fleet(tmp_path: Path, wheels: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[RobotFleet]:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.delenv("SSH_AUTH_SOCK", raising=False)
    monkeypatch.delenv("MESHCTL_INVENTORY", raising=False)
    running = RobotFleet(tmp_path, wheels)
    yield running
    running.stop()
