"""A machine whose robots have LANs with subnets of their own."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.meshlab.qemu.conftest import Lab, field_lab

INVENTORY = Path(__file__).with_name("inventory")


class RoutedLab(Lab):
    """The radios of the base and of the Husky route to LANs of their own; Spot is bridged."""

    NODES = ("base", "b01", "husky-front", "husky-rear", "spot-radio")
    FAR_COMPUTER = "10.43.1.10"


@pytest.fixture(scope="package")
def routed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RoutedLab]:
    """The nodes, bootstrapped on the bench and unplugged."""
    with field_lab(RoutedLab, INVENTORY, tmp_path_factory.mktemp("routed")) as made:
        yield made
