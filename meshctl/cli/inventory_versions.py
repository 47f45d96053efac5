"""Values that follow every edit of the inventory, for commands that run for hours."""

from __future__ import annotations

import os
from pathlib import Path

from meshctl.diagnostics import InvalidInput
from meshctl.errors import InputError
from meshctl.inventory.load import load_fleet
from meshctl.model import Fleet
from meshctl.nodes.link_snapshots import carried_beacons, rack_of


def versions(fleet: Fleet) -> tuple[tuple[int, int] | None, ...]:
    """Changes with every edit of a file of the inventory."""
    found: list[tuple[int, int] | None] = []
    for file in fleet.files:
        try:
            state = Path(file).stat()
        except OSError:
            found.append(None)
        else:
            found.append((state.st_mtime_ns, state.st_size))
    return tuple(found)


class BeaconStock:
    """The beacons that a robot carries according to the inventory, as of its last edit (`meshctl deployed`)."""

    def __init__(self, fleet: Fleet, robot: str) -> None:
        self._robot = robot
        self._fleet = fleet
        self._versions = versions(fleet)

    def count(self) -> int | None:
        """None if the inventory lists none of the robot's. An inventory with errors leaves the last number."""
        self._read_again()
        return carried_beacons(self._fleet, self._robot) if self._robot in self._fleet.robots else None

    def names(self) -> frozenset[str]:
        """Of those on board."""
        self._read_again()
        return rack_of(self._fleet, self._robot)

    def _read_again(self) -> None:
        now = versions(self._fleet)
        if now != self._versions:
            try:
                fleet = load_fleet(Path(self._fleet.files[0]), environ=os.environ)
            except (InputError, InvalidInput):
                # perhaps an edit that is not finished
                pass
            else:
                self._fleet = fleet
            self._versions = now
