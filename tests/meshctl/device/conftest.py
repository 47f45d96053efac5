"""Nodes and servers for the device tests."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from meshctl.device.ssh import SshConnection
from tests.meshctl.device.sandbox import Sandbox
from tests.meshctl.device.servers import Server, dropbear, log_in, ready


@pytest.fixture
def node(tmp_path: Path) -> Iterator[Sandbox]:
    """A node with the dead-man's switch installed and nothing else on it."""
    sandbox = Sandbox(tmp_path / "node")
    yield sandbox
    sandbox.close()


@pytest.fixture
def server(node: Sandbox, tmp_path: Path) -> Iterator[Server]:
    """The node's dropbear, which lets in the key pair `operator` of the test's directory."""
    ready(node, tmp_path)
    with dropbear(node) as running:
        yield running


@pytest.fixture
def connection(server: Server, node: Sandbox, tmp_path: Path) -> Iterator[SshConnection]:
    with log_in(server, node, tmp_path) as connected:
        yield connected
