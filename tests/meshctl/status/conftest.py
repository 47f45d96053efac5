"""The fleet of the status tests."""

from __future__ import annotations

from pathlib import Path

import pytest

from meshctl.model import Fleet
from tests.meshctl.status.fleets import trio


@pytest.fixture
def fleet(tmp_path: Path) -> Fleet:
    return trio(tmp_path)
