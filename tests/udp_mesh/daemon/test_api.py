"""The local socket under load: clients that do not read, too many clients, the largest messages."""

from __future__ import annotations

import asyncio
import socket
import tempfile
from collections.abc import Awaitable, Callable
from pathlib import Path

import pytest

from tests.udp_mesh.links.sockets import WAIT_S
from udp_mesh.client import MeshClient, MeshError
from udp_mesh.client.mesh_client import FrameReader, Header, encode_frame
from udp_mesh.core.settings import Limits
from udp_mesh.daemon import api
from udp_mesh.daemon.api import Client, LocalServer


class Answers:
    """Answers every request at once."""

    def request(self, client: Client, header: Header, payload: bytes) -> None:
        client.reply(header.get("id"), payload)

    def client_read(self) -> None:
        pass

    def client_gone(self, client: Client) -> None:
        pass


def serve(work: Callable[[LocalServer, Path], Awaitable[None]]) -> None:
    """Runs `work` with a listening server."""

    async def run() -> None:
        with tempfile.TemporaryDirectory(prefix="udp-mesh-") as folder:
            path = Path(folder) / "api.sock"
            server = LocalServer(Answers(), path, mode=0o600, group=None, max_payload_bytes=lambda: 1 << 20)
            await server.start()
            try:
                await work(server, path)
            finally:
                await server.close()

    asyncio.run(run())


async def connected(server: LocalServer, path: Path, count: int) -> list[socket.socket]:
    """Connected clients that read nothing."""
    loop = asyncio.get_running_loop()
    before = len(server.clients)
    programs = []
    for _ in range(count):
        program = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        program.setblocking(False)
        await loop.sock_connect(program, str(path))
        programs.append(program)
    await until(lambda: len(server.clients) == before + count)
    return programs


async def until(condition: Callable[[], bool]) -> None:
    async with asyncio.timeout(WAIT_S):
        while True:
            if condition():
                return
            await asyncio.sleep(0)


async def read(program: socket.socket, wanted: Callable[[list[Header]], bool]) -> list[Header]:
    """Headers of received frames, until `wanted`."""
    reader, found = FrameReader(), list[Header]()
    async with asyncio.timeout(WAIT_S):
        while not wanted(found):
            data = await asyncio.get_running_loop().sock_recv(program, 1 << 20)
            assert data
            found += [header for header, _ in reader.feed(data)]
    return found


def test_the_largest_message_reaches_a_client_without_backlog() -> None:
    async def work(server: LocalServer, path: Path) -> None:
        (program,) = await connected(server, path, 1)
        (client,) = server.clients
        client.send_event({"event": "message"}, bytes(Limits().message_bytes))
        found = await read(program, bool)
        assert found == [{"event": "message"}]
        assert server.dropped_for_slow_clients == 0
        program.close()

    serve(work)


def test_the_total_backlog_of_slow_clients_is_bounded_without_affecting_others(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(api, "MAX_TOTAL_BACKLOG_BYTES", 10_000_000)
    frame = encode_frame({"event": "message"}, bytes(500_000))
    rounds = 60

    async def work(server: LocalServer, path: Path) -> None:
        lazy = await connected(server, path, 9)
        idle = list(server.clients)
        (program,) = await connected(server, path, 1)
        reading = asyncio.create_task(read(program, lambda found: len(found) == rounds))
        (reader,) = [client for client in server.clients if client not in idle]
        for _ in range(rounds):
            for client in server.clients:
                client.send_encoded(frame)
            await until(lambda: not reader.backlog_bytes())
        assert len(await reading) == rounds
        # The whole backlog, and at most one frame each beyond its share
        assert sum(client.backlog_bytes() for client in idle) < 10_000_000 + 9 * 1_000_000
        received = await read(lazy[0], lambda found: "dropped" in [header["event"] for header in found])
        assert len(received) + received[-1]["messages"] - 1 == rounds
        for one in (*lazy, program):
            one.close()

    serve(work)


def test_partial_requests_are_bounded_in_total_without_affecting_other_clients(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(api, "MAX_PARTIAL_REQUEST_BYTES", 4_000_000)
    request = encode_frame({"op": "publish", "id": 1}, bytes(1 << 20))

    async def work(server: LocalServer, path: Path) -> None:
        loop = asyncio.get_running_loop()
        programs = await connected(server, path, 9)
        most = 0

        async def look() -> None:
            nonlocal most
            while True:
                most = max(most, sum(client.partial_request_bytes() for client in server.clients))
                await asyncio.sleep(0)

        looking = asyncio.create_task(look())
        for program in programs[:8]:
            await loop.sock_sendall(program, request[:-1])
        await loop.sock_sendall(programs[8], encode_frame({"op": "publish", "id": 2}, b"whole"))
        assert [answer["ok"] for answer in await read(programs[8], bool)] == [True]
        replies = []
        for program in programs[:8]:
            await loop.sock_sendall(program, request[-1:])
            replies += await read(program, bool)
        assert {answer["id"] for answer in replies} == {1}
        assert {answer.get("code") for answer in replies} == {None, "busy"}
        # Plus one read of asyncio
        assert most <= 4_000_000 + 256 * 1024
        looking.cancel()
        for program in programs:
            program.close()

    serve(work)


def test_a_client_beyond_the_limit_is_rejected_with_a_reason() -> None:
    async def work(server: LocalServer, path: Path) -> None:
        programs = await connected(server, path, api.MAX_CLIENTS)

        def ask() -> None:
            with MeshClient(str(path), timeout_s=WAIT_S) as client:
                client.request("peers")

        with pytest.raises(MeshError, match="too many clients: at most 256 may connect at a time") as refused:
            await asyncio.to_thread(ask)
        assert refused.value.code == "too-many-clients"
        programs.pop().close()
        await until(lambda: len(server.clients) < api.MAX_CLIENTS)
        await asyncio.to_thread(ask)
        for program in programs:
            program.close()

    serve(work)
