"""The guide's example runs as printed, and every bridge reads as Python 3.8."""

from __future__ import annotations

import ast
import re
import socket
import subprocess
import sys
from pathlib import Path

import pytest

import udp_mesh
from tests.udp_mesh.daemon.processes import RunningDaemon, poll, two_daemons
from tests.udp_mesh.links.sockets import WAIT_S, free_port

PACKAGE = Path(udp_mesh.__file__).parent
GUIDE = PACKAGE.parent / "docs" / "bridges.md"
SOURCES = sorted(path for part in ("bridges", "client") for path in (PACKAGE / part).rglob("*.py"))


def example() -> str:
    found = re.search(r"```python\n(.*?)```", GUIDE.read_text(), re.DOTALL)
    assert found is not None
    return found[1]


def start(daemon: RunningDaemon, script: Path, listen: int, deliver: int) -> subprocess.Popen[bytes]:
    options = ["--socket", str(daemon.socket), "--topic", "status", "--listen", str(listen), "--deliver", str(deliver)]
    return subprocess.Popen([sys.executable, str(script), *options], stdout=subprocess.DEVNULL)


def test_the_example_is_short_and_carries_datagrams(tmp_path: Path) -> None:
    assert example().count("\n") < 100
    script = tmp_path / "datagrams.py"
    script.write_text(example())
    with two_daemons() as (alice, bob), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.setblocking(False)
        port = free_port()
        processes = [
            start(alice, script, port, free_port()),
            start(bob, script, free_port(), int(receiver.getsockname()[1])),
        ]
        try:
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:

                def arrived() -> bytes | None:
                    sender.sendto(b"hello", ("127.0.0.1", port))
                    try:
                        return receiver.recv(100)
                    except BlockingIOError:
                        return None

                assert poll(arrived, "a datagram") == b"alice hello"
        finally:
            for process in processes:
                process.terminate()
                process.wait(WAIT_S)


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_bridges_and_client_are_python_3_8(path: Path) -> None:
    ast.parse(path.read_text(), feature_version=(3, 8))
