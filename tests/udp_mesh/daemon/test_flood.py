"""A flood from strangers is read in small batches with pauses between them; known peers have a socket of their own."""

from __future__ import annotations

import asyncio
import socket

import pytest

from tests.udp_mesh.daemon.test_api_node import make, online, run
from tests.udp_mesh.links.sockets import WAIT_S, free_port
from udp_mesh import Node
from udp_mesh.core.events import MessageDelivered
from udp_mesh.daemon.driver import MAX_DRAIN_DATAGRAMS
from udp_mesh.daemon.stranger_throttle import FLOOD_BATCH
from udp_mesh.links.udp import Deliver, UdpLink

STRANGER = "127.0.4.66"


def test_datagrams_from_an_online_peer_arrive_on_the_peer_socket(monkeypatch: pytest.MonkeyPatch) -> None:
    async def body(alice: Node, bob: Node) -> None:
        from_strangers = 0
        real = UdpLink.receive_from_strangers

        def receive(self: UdpLink, deliver: Deliver, limit: int, stop_after: float) -> int:
            nonlocal from_strangers
            from_strangers += real(self, deliver, limit, stop_after)
            return 0

        monkeypatch.setattr(UdpLink, "receive_from_strangers", receive)
        for node in (alice, bob):
            for name, link in node.driver.hub.links.items():
                assert link.peers == node.driver.node.peer_addresses()[name]
                assert len(link.peers) == 1
        assert isinstance(await alice.deliver("map", bytes(500_000), to="bob"), MessageDelivered)
        assert from_strangers == 0

    run(body)


def test_a_peer_that_left_is_a_stranger_again() -> None:
    async def body(alice: Node, bob: Node) -> None:
        await bob.__aexit__(None, None, None)
        while any(link.peers for link in alice.driver.hub.links.values()):  # noqa: ASYNC110
            await asyncio.sleep(0.01)

    run(body)


def test_a_flood_is_read_a_few_at_a_time_with_pauses_and_logged_once(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    async def body(alice: Node, bob: Node) -> None:
        (link,) = bob.driver.hub.links.values()
        limits: list[int] = []
        paused: list[bool] = []
        real = UdpLink.receive_from_strangers

        def receive(self: UdpLink, deliver: Deliver, limit: int, stop_after: float) -> int:
            if self is link:
                limits.append(limit)
                paused.append(bob.driver.strangers.paused)
            return real(self, deliver, limit, stop_after)

        monkeypatch.setattr(UdpLink, "receive_from_strangers", receive)
        with socket.socket(type=socket.SOCK_DGRAM) as attacker:
            attacker.bind((STRANGER, 0))
            for _ in range(200):
                for _ in range(20):
                    attacker.sendto(b"\x93" + bytes(100), link.attachment.address)
                assert isinstance(await alice.deliver("status", b"urgent", to="bob"), MessageDelivered)
        assert limits[0] == MAX_DRAIN_DATAGRAMS
        assert FLOOD_BATCH in limits
        assert not any(paused), "read during a pause"
        # Once the flood is over, strangers are read as before.
        while bob.driver.strangers.flooded:
            with socket.socket(type=socket.SOCK_DGRAM) as stranger:
                stranger.sendto(b"\x93" + bytes(100), link.attachment.address)
            await asyncio.sleep(0.01)
        assert not bob.driver.strangers.paused

    run(body)
    assert len([record for record in caplog.records if record.message.startswith("flood ")]) == 1


def test_a_new_peer_is_discovered_during_a_flood_from_its_own_host() -> None:
    async def main() -> None:
        port = free_port()
        async with asyncio.timeout(WAIT_S), make("alice", 1, 2, port) as alice:
            (link,) = alice.driver.hub.links.values()

            async def flood() -> None:
                with socket.socket(type=socket.SOCK_DGRAM) as attacker:
                    attacker.bind(("127.0.4.2", 0))
                    while True:
                        for _ in range(20):
                            attacker.sendto(b"\x90" + bytes(100), link.attachment.address)
                        await asyncio.sleep(0.005)

            flooding = asyncio.create_task(flood())
            async with make("bob", 2, 1, port) as bob:
                await asyncio.gather(online(alice, "bob"), online(bob, "alice"))
            flooding.cancel()

    asyncio.run(main())
