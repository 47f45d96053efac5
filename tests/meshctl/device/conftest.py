"""Nodes and servers for the device tests."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.meshctl.device.sandbox import Sandbox


@pytest.fixture
def node(tmp_path: Path) -> Iterator[Sandbox]:
    """A node with the dead-man's switch installed and nothing else on it."""
    sandbox = Sandbox(tmp_path / "node")
    yield sandbox
    sandbox.close()
