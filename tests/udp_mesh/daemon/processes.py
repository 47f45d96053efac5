"""Real daemons for tests: processes on loopback addresses of their own, polled with generous deadlines."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import TypeVar

from tests.udp_mesh.links.sockets import WAIT_S, free_port
from tests.waiting import until
from udp_mesh.client import MeshClient, MeshError, Message

KEY = "00112233445566778899aabbccddeeff" * 2
OTHER_KEY = "ffeeddccbbaa99887766554433221100" * 2

RATES = """
[rates]
heartbeat_s = 0.2
heartbeat_sparse_s = 0.2
offline_s = 3.0
"""
"""Faster than in the field, so that tests that wait for discovery are short."""

PATIENT_RATES = RATES.replace("offline_s = 3.0", "offline_s = 15.0")
"""For many processes on a busy machine: one that was not scheduled for some seconds does not go offline."""


T = TypeVar("T")


def poll(condition: Callable[[], T | None], what: str) -> T:
    """`until`, with the timeout for real processes."""
    return until(condition, what, wait_s=WAIT_S)


class RunningDaemon:
    """One daemon process that can be killed and started again with the same files."""

    def __init__(self, folder: Path, name: str, configuration: str) -> None:
        self.folder = folder
        self.name = name
        self.socket = folder / f"{name}.sock"
        self.file = folder / f"{name}.toml"
        self.log = folder / f"{name}.log"
        self.environment: dict[str, str] = {}
        self.prefix: list[str] = []
        """Command prefix for the daemon, such as `unshare --net`."""
        self.module = ["udp_mesh.cli.main"]
        """What runs `udp-mesh`, with arguments of its own."""
        self.process: subprocess.Popen[bytes] | None = None
        self.write(configuration)

    def write(self, configuration: str) -> None:
        """Replaces the configuration's file; the daemon reads it at its start and on reload."""
        self.file.write_text(configuration)

    def start(self) -> None:
        """Starts the process and waits until it answers."""
        with self.log.open("ab") as log:
            self.process = subprocess.Popen(
                [*self.prefix, sys.executable, "-m", *self.module, "run", str(self.file)],
                stdout=log,
                stderr=subprocess.STDOUT,
                env={**os.environ, **self.environment},
            )
        poll(self._answers, f"{self.name} answers: {self.log.read_text()}")

    def _answers(self) -> bool:
        assert self.process is not None
        assert self.process.poll() is None, self.log.read_text()
        try:
            with self.client() as client:
                client.request("peers")
        except MeshError:
            return False
        return True

    def client(self) -> MeshClient:
        return MeshClient(str(self.socket), timeout_s=WAIT_S)

    def signal(self, number: signal.Signals) -> None:
        assert self.process is not None
        self.process.send_signal(number)

    def kill(self) -> None:
        """SIGKILL: nothing is cleaned up."""
        assert self.process is not None
        self.process.kill()
        self.process.wait(WAIT_S)
        self.process = None

    def stop(self) -> int:
        """SIGTERM; returns the exit code."""
        if self.process is None:
            return 0
        self.process.terminate()
        code = self.process.wait(WAIT_S)
        self.process = None
        return code

    def __enter__(self) -> RunningDaemon:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()


def configuration(
    folder: Path,
    name: str,
    own: int,
    others: Sequence[int],
    port: int,
    *,
    topics: str = "",
    keys: Sequence[str] = (KEY,),
    more: str = "",
    rates: str = RATES,
) -> str:
    """A node at 127.0.3.<own> with fixed neighbors at 127.0.3.<others>."""
    key_file = folder / f"{name}.key"
    key_file.write_text("\n".join(keys) + "\n")
    neighbours = "".join(f'[[neighbours]]\naddress = "127.0.3.{other}"\n' for other in others)
    return f"""
name = "{name}"
port = {port}
key_file = "{key_file}"
[[links]]
address = "127.0.3.{own}"
kind = "neighbours"
{neighbours}
[topics]
status = {{ priority = 0 }}
map = {{ priority = 7 }}
video = {{ priority = 9, reliable = false, keep_last = 2 }}
{topics}
{rates}
[daemon]
socket = "{folder / name}.sock"
state_directory = "{folder / name}"
{more}
"""


@contextmanager
def two_daemons(topics: str = "", alice_more: str = "") -> Iterator[tuple[RunningDaemon, RunningDaemon]]:
    """Alice and bob, running and online to each other."""
    # A Unix socket's path has at most 107 bytes: pytest's folders are too long.
    with tempfile.TemporaryDirectory(prefix="udp-mesh-") as path:
        folder, port = Path(path), free_port()
        alice = RunningDaemon(
            folder, "alice", configuration(folder, "alice", 1, [2], port, topics=topics, more=alice_more)
        )
        bob = RunningDaemon(folder, "bob", configuration(folder, "bob", 2, [1], port, topics=topics))
        with alice, bob:
            wait_online(alice, "bob")
            wait_online(bob, "alice")
            yield alice, bob


def wait_online(daemon: RunningDaemon, peer: str, online: bool = True) -> None:
    """Waits until the daemon considers the peer online (or offline)."""
    with daemon.client() as client:
        poll(
            lambda: {found["name"]: found["online"] for found in client.request("peers")["peers"]}.get(peer) == online,
            f"{daemon.name} holds {peer} for {'online' if online else 'offline'}",
        )


def collect(client: MeshClient, count: int) -> list[Message]:
    """Waits until `count` messages have arrived."""
    found: list[Message] = []
    for message in client.messages(WAIT_S):
        found.append(message)
        if len(found) == count:
            break
    received = [(message.source, message.topic, len(message.payload)) for message in found]
    assert len(found) == count, f"expected {count} messages within {WAIT_S:g} s, found {len(found)}: {received}"
    return found


def outcomes(client: MeshClient, count: int) -> dict[int, str]:
    """Waits for the outcome of `count` messages."""
    found: dict[int, str] = {}
    while len(found) < count:
        frame = client.next_frame(WAIT_S)
        assert frame is not None, f"{count - len(found)} messages have no outcome"
        if frame[0].get("event") == "outcome":
            assert frame[0]["message_id"] not in found, "a second outcome"
            found[frame[0]["message_id"]] = frame[0]["outcome"]
    return found
