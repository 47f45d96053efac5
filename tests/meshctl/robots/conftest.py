"""Robots on a network of their own, and wheels for them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.meshctl.robots.fleets import RobotFleet
from tests.meshctl.robots.lan import Lan
from tests.meshctl.robots.machine import debian
from tests.meshctl.robots.wheels import repack


@pytest.fixture(scope="session")
def base() -> Path:
    """The Debian that the machines stand on; building it the first time takes its while."""
    return debian()


@pytest.fixture(scope="session")
def wheels(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return repack(tmp_path_factory.mktemp("wheels"))


@pytest.fixture
def fleet(base: Path, wheels: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[RobotFleet]:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.delenv("SSH_AUTH_SOCK", raising=False)
    monkeypatch.delenv("MESHCTL_INVENTORY", raising=False)
    monkeypatch.delenv("MESHCTL_SUDO_PASSWORD", raising=False)
    lan = Lan()
    running = RobotFleet(tmp_path, wheels, base, lan)
    try:
        with lan.inside():
            yield running
    finally:
        running.stop()
        lan.close()
