"""The release that a robot should have: the inventory's configuration and our own wheel -> `ExpectedRelease`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from meshctl.model import Fleet, Secret, SecretRef
from meshctl.robots.bundle import OPTIONAL_UNITS, UNIT_NAME, configuration
from meshctl.robots.collector_release import collector_wheel, has_collector
from meshctl.robots.wheels import own_wheel, stock_units


@dataclass(frozen=True, slots=True)
class ExpectedRelease:
    """The desired release of one robot: `files` are hashes by path, `wheels` those of our own packages, by name."""

    files: Mapping[str, str] = field(default_factory=dict)
    wheels: Mapping[str, str] = field(default_factory=dict)

    @property
    def units(self) -> tuple[str, ...]:
        """The systemd units, the daemon's first."""
        return (UNIT_NAME, *(name for name in OPTIONAL_UNITS if name in self.files))


def expected_release(fleet: Fleet, robot: str, secrets: Callable[[SecretRef], Secret]) -> ExpectedRelease:
    """The desired release of one robot, without the wheels that only a deploy needs.

    Raises InvalidInput for settings the daemon would reject, and for missing keys.
    """
    files = {file.path: file.sha256 for file in configuration(fleet, robot, secrets, stock_units())}
    wheels = {"udp-mesh": own_wheel().sha256}
    if has_collector(fleet, robot):
        wheels["the collector"] = collector_wheel().sha256
    return ExpectedRelease(files, wheels)
