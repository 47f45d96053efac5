"""The guide's example runs as printed."""

from __future__ import annotations

import re
import select
import socket
import subprocess
import sys
from pathlib import Path
from typing import BinaryIO

import udp_mesh
from tests.udp_mesh.bridges.ros1_processes import free_tcp_port
from tests.udp_mesh.daemon.processes import RunningDaemon, poll, two_daemons, wait_online
from tests.udp_mesh.links.sockets import WAIT_S

PACKAGE = Path(udp_mesh.__file__).parent
GUIDE = PACKAGE.parent / "docs" / "bridges.md"


def example() -> str:
    found = re.search(r"```python\n(.*?)```", GUIDE.read_text(), re.DOTALL)
    assert found is not None
    return found[1]


def start(daemon: RunningDaemon, script: Path, source: int, serve: int, *more: str) -> subprocess.Popen[bytes]:
    options = ["--socket", str(daemon.socket), "--topic", "status", "--source", f"127.0.0.1:{source}"]
    return subprocess.Popen(
        [sys.executable, str(script), *options, "--serve", str(serve), *more], stdout=subprocess.DEVNULL
    )


def connect(port: int) -> socket.socket:
    def connected() -> socket.socket | None:
        try:
            return socket.create_connection(("127.0.0.1", port), WAIT_S)
        except ConnectionRefusedError:
            return None

    return poll(connected, f"a listener at port {port}")


def test_the_example_bridge_is_short_and_relays_lines(tmp_path: Path) -> None:
    assert example().count("\n") < 120
    script = tmp_path / "text_bridge.py"
    script.write_text(example())
    with two_daemons() as (alice, bob), socket.create_server(("127.0.0.1", 0)) as source:
        source.settimeout(WAIT_S)
        said, read = int(source.getsockname()[1]), free_tcp_port()
        processes = [start(alice, script, said, free_tcp_port()), start(bob, script, free_tcp_port(), read)]
        try:
            speaker = source.accept()[0]
            with speaker, connect(read) as reader, reader.makefile("rb") as lines:
                speak_until_heard(speaker, reader, lines)
                # The daemon is killed, and the source's connection with it: both are found again.
                alice.kill()
                alice.start()
                wait_online(bob, "alice")
                speaker.sendall(b"into the void\n" * 2)
                with source.accept()[0] as again:
                    speak_until_heard(again, reader, lines)
        finally:
            for process in processes:
                process.terminate()
                process.wait(WAIT_S)


def test_the_example_bridge_reads_a_yarp_port(tmp_path: Path) -> None:
    """The port is written from YARP's documentation, `YARP without YARP`."""
    script = tmp_path / "text_bridge.py"
    script.write_text(example())
    with two_daemons() as (alice, bob), socket.create_server(("127.0.0.1", 0)) as port:
        port.settimeout(WAIT_S)
        address, read = int(port.getsockname()[1]), free_tcp_port()
        processes = [
            start(alice, script, address, free_tcp_port(), "--yarp"),
            start(bob, script, free_tcp_port(), read),
        ]
        try:
            with port.accept()[0] as asker, asker.makefile("rb") as asked, connect(read) as reader:
                assert asked.readline() == b"CONNECT /mesh\n"
                asker.sendall(b"Welcome /mesh\n")
                assert asked.readline() == b"r\n"
                with reader.makefile("rb") as lines:
                    speak_until_heard(asker, reader, lines, b"do 2654 1215723086.182938\nhello\n")
        finally:
            for process in processes:
                process.terminate()
                process.wait(WAIT_S)


def speak_until_heard(
    speaker: socket.socket, reader: socket.socket, lines: BinaryIO, message: bytes = b"hello\r\n"
) -> None:
    """Repeats it until a reader receives it, since discovery takes a while."""

    def heard() -> bytes | None:
        speaker.sendall(message)
        return lines.readline() if select.select([reader], [], [], 0.1)[0] else None

    assert poll(heard, "a line") == b"alice hello\n"
