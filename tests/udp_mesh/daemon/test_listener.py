"""The local socket outlives its file, leaves another daemon's alone; a crowd takes no descriptor that is needed."""

from __future__ import annotations

import asyncio
import errno
import os
import socket
import tempfile
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import cast

import pytest

from tests.udp_mesh.daemon.processes import RunningDaemon, collect, configuration, outcomes, poll, wait_online
from tests.udp_mesh.links.sockets import WAIT_S, free_port
from udp_mesh.client import MeshClient, MeshError
from udp_mesh.daemon import listener
from udp_mesh.daemon.listener import Listener


def listening(work: Callable[[Listener, Path, list[socket.socket]], Awaitable[None]]) -> None:
    """Runs `work` with an open listener and the list of accepted connections."""

    async def run() -> None:
        with tempfile.TemporaryDirectory(prefix="udp-mesh-") as folder:
            path, taken = Path(folder) / "api.sock", list[socket.socket]()
            one = Listener(path, mode=0o600, group=None, on_connection=taken.append)
            one.open()
            try:
                async with asyncio.timeout(WAIT_S):
                    await work(one, path, taken)
            finally:
                one.close()
                for connection in taken:
                    connection.close()

    asyncio.run(run())


@pytest.mark.parametrize("what", ["file", "directory"])
def test_a_path_that_is_not_a_socket_is_left_alone_and_reported(tmp_path: Path, what: str) -> None:
    path = tmp_path / "api.sock"
    if what == "file":
        path.write_text("kept")
    else:
        path.mkdir()
    with pytest.raises(OSError, match=f"api.sock: expected no file or a stale socket, found a {what}"):
        Listener(path, mode=0o600, group=None, on_connection=socket.socket.close).open()
    assert path.exists()


def connect(path: Path) -> None:
    """A client connects and disconnects as soon as the socket exists."""

    def attempt() -> bool:
        with socket.socket(socket.AF_UNIX) as program:
            try:
                program.connect(str(path))
            except FileNotFoundError:
                return False
        return True

    poll(attempt, f"{path} is there")


async def accepted(path: Path, taken: list[socket.socket]) -> None:
    """A program connects at the path, and is accepted."""
    before = len(taken)
    await asyncio.to_thread(connect, path)
    await asyncio.to_thread(poll, lambda: len(taken) > before, "the program is accepted")


def test_a_deleted_socket_is_recreated_with_its_mode(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(listener, "FILE_CHECK_S", 0.02)

    async def work(_: Listener, path: Path, taken: list[socket.socket]) -> None:
        await accepted(path, taken)
        os.unlink(path)
        await accepted(path, taken)
        assert os.stat(path).st_mode & 0o777 == 0o600

    listening(work)


def test_a_socket_replaced_by_another_daemon_is_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(listener, "FILE_CHECK_S", 0.02)

    async def work(first: Listener, path: Path, taken: list[socket.socket]) -> None:
        await accepted(path, taken)
        os.unlink(path)
        with socket.socket(socket.AF_UNIX) as other:
            other.bind(str(path))
            other.listen()
            # several looks
            await asyncio.sleep(0.1)
            first.close()
            connect(path)
            other.accept()[0].close()
        assert len(taken) == 1

    listening(work)


def test_an_unknown_socket_group_leaves_no_socket_file() -> None:
    with tempfile.TemporaryDirectory(prefix="udp-mesh-") as folder:
        path = Path(folder) / "api.sock"
        with pytest.raises(OSError, match="no such group"):
            Listener(path, mode=0o660, group="no-such-group", on_connection=socket.socket.close).open()
        assert not path.exists()


def test_accepting_pauses_when_file_descriptors_run_out(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(listener, "ACCEPT_RETRY_S", 0.02)

    async def work(one: Listener, path: Path, taken: list[socket.socket]) -> None:
        real, refused = cast(socket.socket, one._socket), 0

        class Exhausted:
            """The socket of a process that has no descriptor left for a while."""

            def accept(self) -> object:
                nonlocal refused
                if refused < 5:
                    refused += 1
                    raise OSError(errno.EMFILE, "Too many open files")
                return real.accept()

            def __getattr__(self, name: str) -> object:
                return getattr(real, name)

        monkeypatch.setattr(one, "_socket", Exhausted())
        await accepted(path, taken)
        assert refused == 5
        assert [record.getMessage() for record in caplog.records] == [
            "local-socket-trouble reason=cannot accept connections: Too many open files"
        ]

    listening(work)


def test_clients_beyond_the_file_descriptor_limit_are_refused_without_disruption() -> None:
    with tempfile.TemporaryDirectory(prefix="udp-mesh-") as path:
        folder, port = Path(path), free_port()
        alice = RunningDaemon(folder, "alice", configuration(folder, "alice", 1, [2], port))
        alice.prefix = ["prlimit", "--nofile=64:64"]
        bob = RunningDaemon(folder, "bob", configuration(folder, "bob", 2, [1], port))
        with alice, bob, bob.client() as receiver, alice.client() as sender:
            receiver.subscribe("*")
            wait_online(alice, "bob")
            programs = [MeshClient(str(alice.socket), timeout_s=WAIT_S) for _ in range(150)]
            try:
                answered = refused = 0
                for program in programs:
                    try:
                        program.request("peers")
                    except MeshError as error:
                        assert error.code == "too-many-clients"
                        refused += 1
                    else:
                        answered += 1
                assert (answered + refused, answered > 5) == (150, True)
                sender.publish("map", bytes(100_000), to="bob", notify=True)
                assert len(collect(receiver, 1)[0].payload) == 100_000
                assert set(outcomes(sender, 1).values()) == {"delivered"}
                # there are descriptors left for the daemon's own needs
                assert sender.request("reload")["ok"]
            finally:
                for program in programs:
                    program.close()
            assert len(alice.log.read_text().splitlines()) < 50
