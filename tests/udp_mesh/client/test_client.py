"""The client's calls beside real daemons, from one thread and from several."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import pytest

from tests.udp_mesh.daemon.processes import RunningDaemon, two_daemons
from tests.udp_mesh.links.sockets import WAIT_S
from udp_mesh import MeshClient, MeshError, Message

pytestmark = pytest.mark.xdist_group("udp_mesh_client")

TOPICS = """
order = { priority = 3, deadline_s = 0.2 }
kept = { priority = 6, outbox = "all" }
"""


@pytest.fixture(scope="module")
def daemons() -> Iterator[tuple[RunningDaemon, RunningDaemon]]:
    with two_daemons(TOPICS) as both:
        yield both


def test_deliver_returns_how_a_message_ended(daemons: tuple[RunningDaemon, RunningDaemon]) -> None:
    alice, bob = daemons
    with alice.client() as sender, bob.client() as receiver:
        receiver.subscribe("status")
        ended = sender.deliver("status", b"ready", to="bob", timeout_s=WAIT_S)
        assert (ended.delivered, ended.peer, ended.outcome, ended.reason) == (True, "bob", "delivered", "")
        assert ended.latency_s is not None
        assert next(receiver.messages(WAIT_S)).payload == b"ready"
        # What others published is left to those who wait for frames.
        number = sender.publish("status", b"again", to="bob", notify=True)
        assert sender.deliver("status", b"more", to="bob", timeout_s=WAIT_S).delivered
        frame = sender.next_frame(WAIT_S)
        assert frame is not None
        assert frame[0]["message_id"] == number


def test_deliver_does_not_wait_for_what_will_not_come(daemons: tuple[RunningDaemon, RunningDaemon]) -> None:
    alice, _ = daemons
    with alice.client() as sender:
        for topic, peer, code in (
            ("video", "bob", "best-effort"),
            ("nosuch", "bob", "unknown-topic"),
            ("status", "carol", "unknown-peer"),
            ("kept", "carol", "timeout"),
        ):
            with pytest.raises(MeshError) as refused:
                sender.deliver(topic, b"hello", to=peer, timeout_s=0.05)
            assert refused.value.code == code
        assert sender.deliver("status", b"hello", to="bob", timeout_s=WAIT_S).delivered


def test_threads_share_a_client(daemons: tuple[RunningDaemon, RunningDaemon]) -> None:
    alice, bob = daemons
    with alice.client() as one, bob.client() as other:
        one.subscribe("status", "map")
        received: list[Message] = []
        reader = threading.Thread(target=lambda: received.extend(one.messages()))
        reader.start()
        with ThreadPoolExecutor(4) as threads:

            def work(number: int) -> bool:
                assert other.deliver("map", bytes([number]), to="alice", timeout_s=WAIT_S).delivered
                assert one.request("peers")["ok"]
                return one.deliver("status", bytes([number]), to="bob", timeout_s=WAIT_S).delivered

            assert all(threads.map(work, range(40)))
        # Wakes the reader, which waits without a timeout.
        one.close()
        reader.join(WAIT_S)
        assert not reader.is_alive()
        assert sorted(message.payload for message in received) == [bytes([number]) for number in range(40)]


def test_a_closed_client_says_so(daemons: tuple[RunningDaemon, RunningDaemon]) -> None:
    client = daemons[0].client()
    client.close()
    client.close()
    for call in (lambda: client.publish("status", b"x"), client.next_frame, lambda: client.request("peers")):
        with pytest.raises(MeshError) as error:
            call()
        assert (error.value.code, str(error.value)) == ("closed", "the client was closed")
    assert list(client.messages()) == []


def test_the_environment_names_the_socket(
    daemons: tuple[RunningDaemon, RunningDaemon], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("UDP_MESH_SOCKET", str(daemons[0].socket))
    with MeshClient() as client:
        assert client.request("status")["conditions"]["name"] == "alice"
    with MeshClient(str(daemons[1].socket)) as client:
        assert client.request("status")["conditions"]["name"] == "bob"
