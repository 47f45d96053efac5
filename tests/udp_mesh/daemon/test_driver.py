"""Edge cases of the driver: full sockets, clock steps, removed links, shutdown."""

import asyncio
import socket
from collections.abc import Sequence
from dataclasses import replace

import pytest

from tests.udp_mesh.daemon.test_api_node import make, online, run
from tests.udp_mesh.links.sockets import WAIT_S, free_port
from udp_mesh import Node
from udp_mesh.core.events import MessageDelivered
from udp_mesh.core.interfaces import Datagram
from udp_mesh.daemon.link_output import MAX_BLOCKED_DATAGRAMS
from udp_mesh.links.attachments import Address
from udp_mesh.links.netlink import NetlinkError
from udp_mesh.links.udp import Deliver, OutgoingDatagram, UdpLink

PAYLOAD = bytes(range(256)) * 2000


def test_a_temporarily_full_socket_loses_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    async def body(alice: Node, bob: Node) -> None:
        real, full_for = UdpLink.send, 200

        def send(self: UdpLink, datagrams: Sequence[OutgoingDatagram]) -> int:
            nonlocal full_for
            if self.attachment.address[0].endswith(".1") and full_for:
                full_for -= 1
                return real(self, datagrams[: len(datagrams) // 2])
            return real(self, datagrams)

        monkeypatch.setattr(UdpLink, "send", send)
        assert isinstance(await alice.deliver("map", PAYLOAD, to="bob"), MessageDelivered)
        assert (await anext(bob.messages())).payload == PAYLOAD
        assert full_for < 200

    run(body)


def test_a_full_socket_has_a_bounded_queue_and_counts_losses(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async def body(alice: Node, bob: Node) -> None:
        monkeypatch.setattr(UdpLink, "send", lambda _self, _datagrams: 0)
        (name,) = alice.driver.hub.links
        address = bob.driver.hub.links["127.0.4.2"].attachment.address
        alice.driver.output.transmit(name, [Datagram(name, address, b"x", urgent=False)] * (3 * MAX_BLOCKED_DATAGRAMS))
        assert alice.driver.output.waiting(name) == MAX_BLOCKED_DATAGRAMS
        assert alice.driver.output.lost_on_full_socket == 2 * MAX_BLOCKED_DATAGRAMS
        monkeypatch.undo()
        assert isinstance(await alice.deliver("status", b"now there is room", to="bob"), MessageDelivered)
        assert alice.driver.output.waiting(name) == 0

    run(body)


def test_a_full_socket_sends_urgent_datagrams_first_and_drops_bulk(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async def body(alice: Node, bob: Node) -> None:
        sent: list[bytes] = []
        room = 0

        def send(_: UdpLink, datagrams: Sequence[OutgoingDatagram]) -> int:
            sent.extend(datagram.data for datagram in datagrams[:room])
            return min(room, len(datagrams))

        driver = alice.driver
        (name,) = driver.hub.links
        address = bob.driver.hub.links["127.0.4.2"].attachment.address
        monkeypatch.setattr(UdpLink, "send", send)
        driver.output.transmit(name, [Datagram(name, address, b"bulk", urgent=False)] * MAX_BLOCKED_DATAGRAMS)
        driver.output.transmit(name, [Datagram(name, address, b"urgent %d" % n, urgent=True) for n in range(3)])
        room = 4
        driver.output._writable(driver.hub.links[name])
        assert sent == [b"urgent 0", b"urgent 1", b"urgent 2", b"bulk"]
        assert driver.output.lost_on_full_socket == 3
        monkeypatch.undo()

    run(body)


@pytest.mark.parametrize("step_s", [-3600.0, -0.2, 0.2, 3600.0])
def test_a_step_of_the_wall_clock_does_not_disturb_the_transport(
    monkeypatch: pytest.MonkeyPatch, step_s: float
) -> None:
    async def body(alice: Node, bob: Node) -> None:
        real = UdpLink._receive

        def receive(self: UdpLink, from_socket: socket.socket, deliver: Deliver, limit: int, stop_after: float) -> int:
            def step(data: memoryview, source: Address, arrived: float) -> None:
                deliver(data, source, arrived + step_s)

            return real(self, from_socket, step, limit, stop_after - step_s)

        times: list[float] = []
        taken, advanced = alice.driver.node.receive, alice.driver._advance_clock

        def take(data: memoryview, link: str, source: Address, now: float) -> None:
            times.append(now)
            taken(data, link, source, now)

        def advance() -> float:
            times.append(advanced())
            return times[-1]

        monkeypatch.setattr(alice.driver.node, "receive", take)
        monkeypatch.setattr(alice.driver, "_advance_clock", advance)
        monkeypatch.setattr(UdpLink, "_receive", receive)
        assert isinstance(await alice.deliver("map", PAYLOAD, to="bob"), MessageDelivered)
        (peer,) = alice.conditions().peers
        assert peer.online
        # the core's time never goes back
        assert len(times) > 10
        assert times == sorted(times)

    run(body)


def test_a_removed_link_closes_and_reopens_when_configured_again() -> None:
    async def body(alice: Node, bob: Node) -> None:
        wishes = alice.driver.hub.configs
        alice.driver.apply_links(())
        assert alice.driver.hub.links == {}
        await alice.send("map", b"waits", to="bob")
        alice.driver.apply_links(wishes)
        assert (await anext(bob.messages())).payload == b"waits"

    run(body)


def test_an_address_in_use_is_reported_and_retried() -> None:
    async def main() -> None:
        port = free_port()
        async with asyncio.timeout(WAIT_S), make("first", 1, 2, port) as first, make("second", 1, 2, port) as second:
            (reason,) = second.driver.link_failures.values()
            assert "in use" in reason
            await first.__aexit__(None, None, None)
            async with make("bob", 2, 1, port):
                await online(second, "bob")
                assert second.driver.link_failures == {}

    asyncio.run(main())


def test_an_unexpected_exception_is_reported_and_the_transport_continues(monkeypatch: pytest.MonkeyPatch) -> None:
    async def body(alice: Node, bob: Node) -> None:
        reported: list[str] = []
        asyncio.get_running_loop().set_exception_handler(lambda _, context: reported.append(str(context["exception"])))
        node, raised = alice.driver.node, 0
        real = node.datagrams_to_send

        def datagrams_to_send(now: float, *, max_bytes: int | None = None) -> list[Datagram]:
            nonlocal raised
            if raised < 3:
                raised += 1
                raise ZeroDivisionError("a bug")
            return real(now, max_bytes=max_bytes)

        monkeypatch.setattr(node, "datagrams_to_send", datagrams_to_send)
        assert isinstance(await alice.deliver("map", PAYLOAD, to="bob"), MessageDelivered)
        assert reported == ["a bug"] * 3

    run(body)


def test_a_failed_interface_dump_is_retried_and_logged_once(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    async def body(alice: Node, bob: Node) -> None:
        def refuse() -> None:
            raise NetlinkError(12, "no memory")

        monkeypatch.setattr(alice.driver.hub, "refresh", refuse)
        for _ in range(5):
            alice.driver._refresh_and_pump()
        assert isinstance(await alice.deliver("map", PAYLOAD, to="bob"), MessageDelivered)
        assert sum("interfaces-unknown" in record.getMessage() for record in caplog.records) == 1

    run(body)


def test_a_bug_in_the_refresh_of_interfaces_leaves_the_links_open(monkeypatch: pytest.MonkeyPatch) -> None:
    async def body(alice: Node, bob: Node) -> None:
        def fail() -> None:
            raise ZeroDivisionError("a bug")

        monkeypatch.setattr(alice.driver.hub, "refresh", fail)
        with pytest.raises(ZeroDivisionError):
            alice.driver._refresh_and_pump()
        assert isinstance(await alice.deliver("map", PAYLOAD, to="bob"), MessageDelivered)

    run(body)


def test_continuous_notices_do_not_postpone_the_refresh_of_interfaces(monkeypatch: pytest.MonkeyPatch) -> None:
    async def body(alice: Node, _: Node) -> None:
        driver = alice.driver
        assert driver._monitor is not None
        monkeypatch.setattr(driver._monitor, "drain", lambda: True)
        driver._interfaces_changed()
        first = driver._refresh_timer
        assert first is not None
        await asyncio.sleep(0.001)
        driver._interfaces_changed()
        assert driver._refresh_timer is first
        # A refresh scheduled for a later retry is moved forward.
        first.cancel()
        later = driver._refresh_timer = asyncio.get_running_loop().call_later(3600.0, driver._refresh_and_pump)
        driver._interfaces_changed()
        assert later.cancelled()

    run(body)


def test_closing_a_node_leaves_no_timers_on_the_event_loop() -> None:
    async def main() -> None:
        async with make("alice", 1, 2, free_port()) as node:
            await node.send("status", b"to nobody yet")
            node.driver.close()
        node.driver.close()
        await asyncio.sleep(0.05)
        loop = asyncio.get_running_loop()
        assert not [handle for handle in getattr(loop, "_scheduled", []) if not handle.cancelled()]

    asyncio.run(main())


def test_changed_rates_take_effect_on_the_running_node() -> None:
    async def body(alice: Node, _: Node) -> None:
        settings = alice.driver.node.settings
        changes = alice.apply(replace(settings, rates=replace(settings.rates, heartbeat_s=0.1)))
        assert changes
        assert alice.driver.node.settings.rates.heartbeat_s == 0.1

    run(body)
