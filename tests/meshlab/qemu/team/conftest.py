"""A second machine with everything encrypted, a robot whose node has two radios, and a factory-fresh spare."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.meshlab.qemu.conftest import Lab, field_lab

INVENTORY = Path(__file__).with_name("inventory")
FIELDED = ("base", "b01", "b02", "husky")
KEYS = {"main": "a word that all of them know", "fast": "and another one for five gigahertz"}


@dataclass(frozen=True, slots=True)
class Team(Lab):
    """The running fleet; `spare` stays on the bench, factory-fresh."""

    NODES = FIELDED

    def write_keys(self, **keys: str) -> None:
        """Set the meshes' keys in the inventory; a node gets them when it is provisioned."""
        lines = "".join(f"{mesh}: {key}\n" for mesh, key in {**KEYS, **keys}.items())
        (self.inventory.parent / "keys.yaml").write_text(lines, encoding="utf-8")

    def stations(self, name: str, interface: str) -> dict[str, bool]:
        """The stations of a node's radio, and whether each is authorized."""
        names = self.names()
        authorized: dict[str, bool] = {}
        mac = ""
        for line in self.on(name, f"iw dev {interface} station dump").splitlines():
            words = line.split()
            if line.startswith("Station"):
                mac = words[1]
            elif words[0] == "authorized:":
                authorized[names[mac]] = words[1] == "yes"
        return authorized


@pytest.fixture(scope="package")
def team(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Team]:
    """The nodes of the field, bootstrapped on the bench and unplugged: they are reached only over the mesh."""
    with field_lab(Team, INVENTORY, tmp_path_factory.mktemp("team"), before=Team.write_keys) as made:
        yield made
