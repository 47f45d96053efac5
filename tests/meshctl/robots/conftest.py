"""Robots on a network of their own, and wheels for them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.made_once import made_once
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
    def make(directory: Path) -> None:
        repack(directory)

    return made_once(tmp_path_factory, "robots-wheels", make)


@pytest.fixture(scope="session")
def seed(base: Path, wheels: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What a deploy leaves of its packages, made by one."""

    def make(directory: Path) -> None:
        with pytest.MonkeyPatch.context() as patch, _running(base, wheels, directory, patch) as fleet:
            fleet.add("husky1", fresh=True)
            fleet.write()
            fleet.deploy()
            fleet.shell("husky1", "cd /opt/udp-mesh && systemctl stop udp-mesh && rm -rf releases current .lock")
        (directory / "kept/opt").mkdir(parents=True)
        (directory / "husky1/upper/opt/udp-mesh").rename(directory / "kept/opt/udp-mesh")

    return made_once(tmp_path_factory, "robots-seed", make) / "kept"


@pytest.fixture
def fleet(
    base: Path, wheels: Path, seed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[RobotFleet]:
    with _running(base, wheels, tmp_path, monkeypatch, seed) as running:
        yield running


@contextmanager
def _running(
    base: Path, wheels: Path, directory: Path, patch: pytest.MonkeyPatch, seed: Path | None = None
) -> Iterator[RobotFleet]:
    patch.setenv("XDG_CACHE_HOME", str(directory / "cache"))
    patch.setenv("XDG_STATE_HOME", str(directory / "state"))
    for name in ("SSH_AUTH_SOCK", "MESHCTL_INVENTORY", "MESHCTL_SUDO_PASSWORD"):
        patch.delenv(name, raising=False)
    lan = Lan()
    running = RobotFleet(directory, wheels, base, lan, seed)
    try:
        with lan.inside():
            yield running
    finally:
        running.stop()
        lan.close()
