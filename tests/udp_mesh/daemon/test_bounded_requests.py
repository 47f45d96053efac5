"""No local request blocks the daemon: special files, idle connections, incomplete requests."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import os
import select
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import cast

import pytest

from tests.udp_mesh.daemon.processes import KEY, RunningDaemon, configuration, two_daemons
from tests.udp_mesh.links.sockets import free_port
from tests.waiting import until
from udp_mesh.client import MeshClient, MeshError
from udp_mesh.client.mesh_client import encode_frame
from udp_mesh.daemon import api, commands, metrics_server
from udp_mesh.daemon.configuration import read_keys
from udp_mesh.daemon.file_access import is_below, is_exposed, read_regular
from udp_mesh.daemon.framing import BadFrame, RequestReader
from udp_mesh.daemon.toml_source import ConfigurationError, parse

pytestmark = pytest.mark.xdist_group("udp_mesh_bounded")


@pytest.fixture(scope="module")
def metrics_port() -> int:
    return free_port()


@pytest.fixture(scope="module")
def alice(metrics_port: int) -> Iterator[RunningDaemon]:
    with two_daemons(alice_more=f'metrics_address = "127.0.0.1:{metrics_port}"\n') as (one, _):
        yield one


@pytest.mark.parametrize("kind", ["pipe", "directory", "socket", "device", "link to a pipe"])
def test_a_key_file_that_is_not_a_regular_file_is_rejected_immediately(
    alice: RunningDaemon, kind: str, tmp_path: Path
) -> None:
    path = tmp_path / "fleet.key"
    if kind == "directory":
        path.mkdir()
    elif kind == "socket":
        with socket.socket(socket.AF_UNIX) as listener:
            listener.bind(str(path))
    elif kind == "device":
        path = Path("/dev/zero")
    else:
        os.mkfifo(tmp_path / "pipe")
        path = tmp_path / "pipe"
        if kind != "pipe":
            path = tmp_path / "link"
            path.symlink_to(tmp_path / "pipe")
    with alice.client() as client:
        with pytest.raises(MeshError, match=r"not a regular file|Is a directory"):
            client.request("set-keys", file=str(path))
        assert client.request("status")["ok"]


def test_a_file_is_read_through_a_symlink(tmp_path: Path) -> None:
    (tmp_path / "real").write_bytes(b"x" * 10)
    (tmp_path / "link").symlink_to(tmp_path / "real")
    assert read_regular(tmp_path / "link", 5) == b"x" * 6


@pytest.mark.parametrize(("text", "found"), [("00" * 32, "only zeros"), (f"{KEY}\n{KEY}", "the same key twice")])
def test_all_zero_and_duplicate_keys_are_rejected(tmp_path: Path, text: str, found: str) -> None:
    path = tmp_path / "fleet.key"
    path.write_text(text)
    with pytest.raises(ConfigurationError, match=found):
        read_keys(path)


def test_a_world_readable_key_file_is_reported(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "fleet.key"
    path.write_text(KEY)
    path.chmod(0o644)
    with caplog.at_level(logging.WARNING):
        read_keys(path)
    assert is_exposed(path)
    assert "key-file-exposed" in caplog.text
    assert KEY not in caplog.text
    caplog.clear()
    path.chmod(0o640)
    read_keys(path)
    assert not caplog.text


def test_deeply_nested_brackets_are_a_configuration_error() -> None:
    with pytest.raises(ConfigurationError, match="brackets"):
        parse("a = " + "[" * 20_000 + "]" * 20_000, "udp-mesh.toml")


@pytest.mark.parametrize("odd", ["NaN", "Infinity", "-Infinity", "1e999", "true", "[1]"])
def test_an_invalid_request_id_is_rejected(odd: str) -> None:
    head = b'{"op": "status", "id": ' + odd.encode() + b"}"
    (found,) = RequestReader(lambda: 100).feed(len(head).to_bytes(4, "big") + bytes(4) + head)
    assert isinstance(found, BadFrame)
    assert found.request_id is None


def test_a_very_large_integer_is_a_valid_request_id() -> None:
    frame = encode_frame({"op": "status", "id": 10**400}, b"")
    (found,) = RequestReader(lambda: 100).feed(frame)
    assert not isinstance(found, BadFrame)


def test_status_is_answered_even_if_all_connections_are_in_use(alice: RunningDaemon) -> None:
    idle = []
    try:
        for _ in range(api.MAX_CLIENTS + 3 * api.MAX_SPARE_CLIENTS):
            one = socket.socket(socket.AF_UNIX)
            one.connect(str(alice.socket))
            idle.append(one)
        # The newest client beyond the limit may send a request, unless too many connect at the same time.
        asked = time.monotonic()
        while True:
            try:
                with MeshClient(str(alice.socket), timeout_s=10.0) as client:
                    assert client.request("status")["ok"]
                break
            except MeshError:
                assert time.monotonic() < asked + 60.0
        with MeshClient(str(alice.socket), timeout_s=10.0) as client:
            with pytest.raises(MeshError) as refused:
                client.request("peers")
            assert refused.value.code == "too-many-clients"
    finally:
        for one in idle:
            one.close()
    deadline = time.monotonic() + 60.0
    while True:
        try:
            with alice.client() as client:
                client.request("peers")
            return
        except MeshError:
            assert time.monotonic() < deadline


def test_metrics_are_served_despite_idle_connections(alice: RunningDaemon, metrics_port: int) -> None:
    count = 3 * metrics_server.MAX_CONNECTIONS

    def are_served_beside_them() -> bool:
        """Whether the answer came before the idle connections timed out; a busy machine may take longer."""
        with contextlib.ExitStack() as stack:
            address = ("127.0.0.1", metrics_port)
            idle = [stack.enter_context(socket.create_connection(address)) for _ in range(count)]
            for one in idle:
                one.send(b"GET /met")
            scraper = stack.enter_context(socket.create_connection(address, timeout=60.0))
            scraper.sendall(b"GET /metrics HTTP/1.1\r\n\r\n")
            assert scraper.recv(64).startswith(b"HTTP/1.1 200 OK")
            return len(select.select(idle, [], [], 0)[0]) < count

    until(are_served_beside_them, "metrics before idle connections time out")


def test_neighbors_and_subscription_patterns_are_limited(alice: RunningDaemon, monkeypatch: pytest.MonkeyPatch) -> None:
    with alice.client() as client:
        with pytest.raises(MeshError, match="at most 1024 patterns"):
            client.request("subscribe", topics=[f"p{number}" for number in range(2000)])
        for number in range(commands.MAX_NEIGHBOURS + 5):
            try:
                client.request("set-neighbour", address=f"10.77.{number >> 8}.{number & 255}")
            except MeshError as error:
                assert error.code == "too-many"
                break
        else:
            pytest.fail("no bound was met")
        client.request("reload")


def test_paths_outside_the_state_directory_are_detected(tmp_path: Path) -> None:
    state, outside = tmp_path / "state", tmp_path / "outside"
    (state / "runs").mkdir(parents=True)
    outside.mkdir()
    (state / "link").symlink_to(outside)
    assert is_below(state / "run.jsonl", state)
    assert is_below(state / "runs" / "run.jsonl", state)
    for path in (outside / "run.jsonl", state / ".." / "run.jsonl", state / "link" / "x", tmp_path / "none" / "x"):
        assert not is_below(path, state)


class Handler:
    """Accepts every request."""

    def __init__(self) -> None:
        self.gone = asyncio.Event()

    def request(self, client: api.Client, header: dict[str, object], payload: bytes) -> None:
        client.reply(header.get("id"))

    def client_read(self) -> None:
        pass

    def client_gone(self, client: api.Client) -> None:
        self.gone.set()


def test_replies_to_a_client_that_has_gone_are_not_logged_one_by_one(caplog: pytest.LogCaptureFixture) -> None:
    async def work(path: Path) -> None:
        handler = Handler()
        server = api.LocalServer(handler, path, mode=0o600, group=None, max_payload_bytes=lambda: 1000)
        await server.start()
        with socket.socket(socket.AF_UNIX) as client:
            client.connect(str(path))
            client.sendall(b"".join(encode_frame({"op": "x", "id": number}, b"") for number in range(100)))
        await handler.gone.wait()
        await server.close()

    with tempfile.TemporaryDirectory(prefix="udp-mesh-") as folder:
        asyncio.run(work(Path(folder) / "s"))
    assert not caplog.records


def test_an_incomplete_request_times_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(api, "PARTIAL_REQUEST_TIMEOUT_S", 0.05)

    async def work(path: Path) -> None:
        server = api.LocalServer(Handler(), path, mode=0o600, group=None, max_payload_bytes=lambda: 1000)
        await server.start()
        reader, writer = await asyncio.open_unix_connection(str(path))
        whole = encode_frame({"op": "x", "id": 1}, b"")
        writer.write(whole)
        assert b'"ok"' in await reader.read(1000)
        writer.write(whole[:6])
        await asyncio.sleep(0)
        (client,) = server.clients
        assert client.user == os.getuid()
        rest = await reader.read()
        assert json.loads(rest[8:])["code"] == "too-slow"
        writer.close()
        await server.close()

    with tempfile.TemporaryDirectory(prefix="udp-mesh-") as folder:
        asyncio.run(work(Path(folder) / "s"))


class PausedTransport:
    """A connection's transport that the test pauses."""

    def __init__(self) -> None:
        self.paused = False
        self.closed = False

    def is_reading(self) -> bool:
        return not self.paused

    def pause_reading(self) -> None:
        self.paused = True

    def get_write_buffer_size(self) -> int:
        return 0

    def get_extra_info(self, _: str) -> None:
        return None

    def is_closing(self) -> bool:
        return self.closed

    def write(self, _: bytes) -> None: ...

    def close(self) -> None:
        self.closed = True


def test_a_request_is_too_slow_only_if_it_could_have_been_read(tmp_path: Path) -> None:
    whole = encode_frame({"op": "x", "id": 1}, b"")

    closed: list[bool] = []

    async def main() -> None:
        server = api.LocalServer(Handler(), tmp_path / "s", mode=0o600, group=None, max_payload_bytes=lambda: 1000)
        client, transport = api.Client(server), PausedTransport()
        client.connection_made(cast(asyncio.BaseTransport, transport))
        client.data_received(whole[:5])
        # The rest came, and as much of the next request.
        client.data_received(whole[5:] + whole[:5])
        client._check_partial_request()
        closed.append(transport.closed)
        # The client does not read its replies, so that its requests wait.
        transport.pause_reading()
        client._check_partial_request()
        closed.append(transport.closed)
        transport.paused = False
        client._check_partial_request()
        closed.append(transport.closed)
        client.connection_lost(None)

    asyncio.run(main())
    assert closed == [False, False, True]


RECORD_AS_ANOTHER_USER = """
import os, sys
from udp_mesh.client import MeshClient, MeshError
socket, path = sys.argv[1:]
os.setuid(65534)
client = MeshClient(socket)
try:
    client.request("record-start", path=path)
    print(client.request("record-stop")["path"])
except MeshError as error:
    print(error.code)
"""


@pytest.mark.skipif(os.geteuid() != 0, reason="needs root to act as another user")
def test_another_user_can_record_only_inside_the_state_directory() -> None:
    with tempfile.TemporaryDirectory(prefix="udp-mesh-") as path:
        folder = Path(path)
        folder.chmod(0o755)
        text = configuration(folder, "alice", 1, [], free_port(), more='socket_mode = "0666"')
        with RunningDaemon(folder, "alice", text) as daemon:
            (folder / "alice").mkdir(exist_ok=True)

            def record(where: Path) -> str:
                done = subprocess.run(
                    [sys.executable, "-c", RECORD_AS_ANOTHER_USER, str(daemon.socket), str(where)],
                    capture_output=True, text=True, check=True, timeout=60,
                )  # fmt: skip
                return done.stdout.strip()

            outside, inside = folder / "outside.jsonl", folder / "alice" / "inside.jsonl"
            assert record(outside) == "cannot-record"
            assert record(folder / "alice" / ".." / "outside.jsonl") == "cannot-record"
            assert not outside.exists()
            assert record(inside) == str(inside)
            assert inside.exists()
            with daemon.client() as own:
                own.request("record-start", path=str(outside))
                own.request("record-stop")
            assert outside.exists()
