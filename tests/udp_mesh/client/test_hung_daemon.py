"""A daemon that accepts connections and then hangs: every call of the client ends."""

from __future__ import annotations

import contextlib
import json
import socket
import struct
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.udp_mesh.links.sockets import WAIT_S
from udp_mesh import MeshClient, MeshError
from udp_mesh.client import mesh_client
from udp_mesh.client.mesh_client import FrameReader, encode_frame

LARGE = bytes(2_000_000)
SHORT_S = 0.05


@pytest.fixture
def listener(tmp_path: Path) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as server:
        server.bind(str(tmp_path / "socket"))
        server.listen(0)
        yield server


def connect(listener: socket.socket, timeout_s: float = SHORT_S) -> tuple[MeshClient, socket.socket]:
    """A client and the daemon's end of its connection."""
    client = MeshClient(listener.getsockname(), timeout_s=timeout_s)
    return client, listener.accept()[0]


@pytest.mark.parametrize("wait", [True, False])
def test_a_message_that_the_daemon_does_not_read_times_out(listener: socket.socket, wait: bool) -> None:
    client, daemon = connect(listener)
    with client, daemon:
        with pytest.raises(MeshError, match=r"read nothing for 0\.05 s") as refused:
            client.publish("map", LARGE, to="bob", wait=wait)
        assert refused.value.code == "timeout"
        # The daemon takes what follows for the rest of the frame.
        with pytest.raises(MeshError) as refused:
            client.publish("status", b"ready", to="bob")
        assert refused.value.code == "unreachable"


def publish_for_ever(client: MeshClient) -> None:
    while True:
        client.publish("status", b"small", wait=False)


def test_a_frame_of_which_nothing_was_sent_leaves_the_connection_usable(listener: socket.socket) -> None:
    client, daemon = connect(listener)
    with client, daemon:
        with pytest.raises(MeshError, match="read nothing"):
            publish_for_ever(client)
        reader = FrameReader()
        daemon.setblocking(False)
        waiting = b""
        with contextlib.suppress(BlockingIOError):
            while True:
                waiting += daemon.recv(1 << 20)
        client.publish("status", b"ready", wait=False)
        payloads = [payload for _, payload in reader.feed(waiting + daemon.recv(1 << 20))]
        assert payloads[:-1] == [b"small"] * (len(payloads) - 1)
        assert payloads[-1] == b"ready"


def test_a_daemon_that_accepts_no_connection_is_unreachable(listener: socket.socket) -> None:
    path = listener.getsockname()
    with MeshClient(path, timeout_s=SHORT_S), pytest.raises(MeshError, match=r"no answer within 0\.05 s") as refused:
        # a backlog of none has room for one or two
        _ = [MeshClient(path, timeout_s=SHORT_S) for _ in range(10)]
    assert refused.value.code == "unreachable"


def test_close_ends_a_publication_that_waits_for_the_daemon(listener: socket.socket) -> None:
    client, daemon = connect(listener, timeout_s=10 * WAIT_S)
    codes: list[str] = []

    def publish() -> None:
        try:
            client.publish("map", LARGE)
        except MeshError as error:
            codes.append(error.code)

    with daemon:
        thread = threading.Thread(target=publish, daemon=True)
        thread.start()
        # Once a part of the frame is there, the thread sends the rest of it.
        assert daemon.recv(1)
        client.close()
        thread.join(WAIT_S)
        assert not thread.is_alive()
    assert codes == ["closed"]


def message(number: int, size: int) -> bytes:
    header = {"event": "message", "source": "bob", "topic": "status", "type": "", "priority": 3, "broadcast": False}
    return encode_frame({**header, "number": number}, bytes(size))


def test_messages_that_a_program_does_not_take_are_dropped_beyond_a_limit(
    listener: socket.socket, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each request reads what comes before its reply."""
    monkeypatch.setattr(mesh_client, "MAX_UNREAD_BYTES", 4 * (1000 + mesh_client.EVENT_BYTES))
    client, daemon = connect(listener, timeout_s=WAIT_S)
    with client, daemon:
        for number in range(10):
            if number == 5:
                daemon.sendall(encode_frame({"event": "peer-online", "peer": "bob"}))
            daemon.sendall(message(number, size=1000))
        daemon.sendall(encode_frame({"id": 1, "ok": True}))
        assert client.request("status")["ok"]
        assert client.next_frame(0) == ({"event": "dropped", "messages": 6}, b"")
        assert [received.number for received in client.messages(0)] == [6, 7, 8, 9]
        # what was taken no longer counts
        daemon.sendall(b"".join(message(number, size=900) for number in (10, 11, 12, 13)))
        daemon.sendall(encode_frame({"id": 2, "ok": True}))
        assert client.request("status")["ok"]
        assert [received.number for received in client.messages(0)] == [10, 11, 12, 13]


def test_a_reply_after_its_timeout_is_dropped(listener: socket.socket) -> None:
    client, daemon = connect(listener)
    with client, daemon:
        with pytest.raises(MeshError, match="no reply"):
            client.request("status")
        for number in (1, 2):
            head = json.dumps({"id": number, "ok": True, "number": number}).encode()
            daemon.sendall(struct.pack(">II", len(head), 0) + head)
        assert client.request("status")["number"] == 2
        assert client._replies == {}
