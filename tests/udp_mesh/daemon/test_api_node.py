"""The transport inside a program: two nodes on one loop, over real sockets."""

import asyncio
import os
import resource
from collections.abc import Callable, Coroutine
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from tests.udp_mesh.links.sockets import WAIT_S, free_port
from udp_mesh import DirectoryStore, Key, LinkConfig, Neighbour, Node, Outbox, SendRefusedError, Settings, Topic
from udp_mesh.core.events import MessageDelivered, MessageExpired, PeerOffline, PeerOnline
from udp_mesh.core.settings import Rates

KEY = Key(bytes(range(32)))
TOPICS = (
    Topic("status", priority=0),
    Topic("map", priority=7),
    Topic("short", deadline_s=0.2),
    Topic("short-stored", deadline_s=0.2, outbox=Outbox.ALL),
    Topic("video", reliable=False),
    Topic("stored", outbox=Outbox.ALL, outbox_on_disk=True),
)


def make(name: str, own: int, other: int, port: int, store: DirectoryStore | None = None) -> Node:
    settings = Settings(
        name=name,
        port=port,
        keys=(KEY,),
        topics=TOPICS,
        neighbours=(Neighbour((f"127.0.4.{other}", port)),),
        rates=Rates(heartbeat_s=0.2, heartbeat_sparse_s=0.2, offline_s=1.0),
    )
    return Node(settings, links=(LinkConfig(address=f"127.0.4.{own}", broadcast=False),), store=store)


async def online(node: Node, peer: str) -> None:
    async for event in node.events():
        if isinstance(event, PeerOnline) and event.peer == peer:
            return


def run(body: Callable[[Node, Node], Coroutine[Any, Any, None]]) -> None:
    """Runs `body` with two nodes that know each other, within a generous time."""

    async def main() -> None:
        port = free_port()
        async with asyncio.timeout(WAIT_S), make("alice", 1, 2, port) as alice, make("bob", 2, 1, port) as bob:
            await asyncio.gather(online(alice, "bob"), online(bob, "alice"))
            await body(alice, bob)

    asyncio.run(main())


def test_deliver_waits_for_the_outcome_of_a_message() -> None:
    async def body(alice: Node, bob: Node) -> None:
        payload = bytes(3_000_000)
        outcome = await alice.deliver("map", payload, to="bob", type_name="bytes")
        assert isinstance(outcome, MessageDelivered)
        message = await anext(bob.messages())
        assert (message.source, message.topic, message.type_name, message.priority) == ("alice", "map", "bytes", 7)
        assert message.payload == payload

    run(body)


def test_a_broadcast_reaches_the_peer() -> None:
    async def body(alice: Node, bob: Node) -> None:
        await alice.send("status", b"to all")
        message = await anext(bob.messages())
        assert (message.payload, message.broadcast) == (b"to all", True)

    run(body)


def test_a_refused_message_raises_with_the_reason() -> None:
    async def body(alice: Node, _: Node) -> None:
        with pytest.raises(SendRefusedError, match="unknown topic"):
            await alice.send("unknown", b"", to="bob")
        with pytest.raises(SendRefusedError, match="unknown peer"):
            await alice.send("status", b"", to="nobody")

    run(body)


def test_deliver_does_not_wait_for_an_outcome_that_never_comes(tmp_path: Path) -> None:
    async def body(alice: Node, _: Node) -> None:
        with pytest.raises(ValueError, match="topic video is best effort"):
            await alice.deliver("video", b"", to="bob")

    run(body)

    async def close_meanwhile() -> None:
        async with make("alice", 1, 2, free_port(), DirectoryStore(tmp_path, 1 << 20)) as alice:
            waiting = asyncio.ensure_future(alice.deliver("stored", b"entry", to="bob"))
            await asyncio.sleep(0)
        with pytest.raises(RuntimeError, match="closed before the outcome"):
            await waiting

    asyncio.run(asyncio.wait_for(close_meanwhile(), WAIT_S))


def test_leaving_is_reported_at_once_and_a_message_to_a_peer_that_left_expires() -> None:
    async def body(alice: Node, bob: Node) -> None:
        await bob.__aexit__(None, None, None)
        async for event in alice.events():
            if isinstance(event, PeerOffline):
                assert event.left
                break
        assert isinstance(await alice.deliver("short", b"late", to="bob"), MessageExpired)
        assert [message async for message in bob.messages()] == []

    run(body)


def test_settings_can_be_changed_at_run_time() -> None:
    async def body(alice: Node, bob: Node) -> None:
        settings = alice.driver.node.settings
        assert alice.apply(replace(settings, topics=(*settings.topics, Topic("extra", priority=1))))
        await alice.send("extra", b"new", to="bob")
        assert (await anext(bob.messages())).topic == "extra"
        with pytest.raises(ValueError, match="name"):
            alice.apply(replace(settings, name="carol"))
        (peer,) = alice.conditions().peers
        assert peer.online

    run(body)


def test_a_node_used_outside_its_context_raises_runtime_error() -> None:
    node = make("alice", 1, 2, 9)
    with pytest.raises(RuntimeError, match="async with"):
        node.conditions()


@pytest.mark.parametrize("payload", ["ready", None, 7, [1, 2]])
def test_a_payload_that_is_not_bytes_is_refused_when_it_is_sent(payload: Any) -> None:
    async def body(alice: Node, bob: Node) -> None:
        with pytest.raises(TypeError, match="payload: expected bytes, found "):
            await alice.send("status", payload, to="bob")
        with pytest.raises(TypeError, match="payload: expected bytes, found "):
            await alice.deliver("status", payload, to="bob")
        assert alice.conditions().counters.messages_sent == 0

    run(body)


def test_a_message_is_what_its_buffer_contained_when_it_was_sent() -> None:
    async def body(alice: Node, bob: Node) -> None:
        buffer = bytearray(b"first" * 1_000)
        view: Any = memoryview(buffer)
        waiting = asyncio.ensure_future(alice.deliver("map", view, to="bob"))
        await asyncio.sleep(0)
        buffer[:] = b"later" * 1_000
        assert isinstance(await waiting, MessageDelivered)
        assert (await anext(bob.messages())).payload == b"first" * 1_000

    run(body)


def test_a_topic_destination_or_type_that_is_no_text_is_named() -> None:
    async def body(alice: Node, bob: Node) -> None:
        wrong: Any = ["bob"]
        for arguments in ({"to": wrong}, {"to": "bob", "type_name": wrong}, {"topic": wrong}):
            with pytest.raises(TypeError, match=r"(to|type_name|topic): expected str, found list"):
                await alice.send(**{"topic": "map", "payload": b"", **arguments})

    run(body)


def test_a_running_node_cannot_be_entered_again() -> None:
    async def body(alice: Node, bob: Node) -> None:
        with pytest.raises(RuntimeError, match="running already"):
            await alice.__aenter__()
        assert isinstance(await alice.deliver("map", b"still here", to="bob"), MessageDelivered)

    run(body)


def test_a_wait_that_timed_out_does_not_end_the_messages() -> None:
    async def body(alice: Node, bob: Node) -> None:
        messages = bob.messages()
        with pytest.raises(TimeoutError):
            await asyncio.wait_for(anext(messages), 0.001)
        await alice.send("map", b"later", to="bob")
        assert (await anext(messages)).payload == b"later"

    run(body)


def test_a_node_is_refused_in_another_loop() -> None:
    async def body(alice: Node, bob: Node) -> None:
        def elsewhere(work: Callable[[], Coroutine[Any, Any, Any]]) -> None:
            with pytest.raises(RuntimeError, match="another event loop"):
                asyncio.run(work())

        async def read() -> None:
            await anext(alice.messages())

        await asyncio.to_thread(elsewhere, lambda: alice.send("status", b"", to="bob"))
        await asyncio.to_thread(elsewhere, lambda: alice.deliver("status", b"", to="bob"))
        await asyncio.to_thread(elsewhere, read)
        assert alice.conditions().counters.messages_sent == 0

    run(body)


def test_a_node_that_ended_can_run_again_in_another_loop() -> None:
    port = free_port()
    nodes = make("alice", 1, 2, port), make("bob", 2, 1, port)

    async def main(payload: bytes) -> None:
        alice, bob = nodes
        async with asyncio.timeout(WAIT_S), alice, bob:
            await asyncio.gather(online(alice, "bob"), online(bob, "alice"))
            assert isinstance(await alice.deliver("map", payload, to="bob"), MessageDelivered)
            assert [message.payload for message in bob._messages] == [payload]
            waiting = asyncio.ensure_future(anext(alice.messages()))
            await asyncio.sleep(0)
            await bob.send("map", payload, to="alice")
            assert (await waiting).payload == payload

    asyncio.run(main(b"first"))
    asyncio.run(main(b"second"))


def test_a_node_that_runs_again_confirms_only_what_is_read() -> None:
    async def main() -> None:
        port = free_port()
        alice, bob = make("alice", 1, 2, port), make("bob", 2, 1, port)
        async with bob:
            bob.apply(replace(bob.driver.node.settings, confirms=False))
        async with asyncio.timeout(WAIT_S), alice, bob:
            await asyncio.gather(online(alice, "bob"), online(bob, "alice"))
            assert bob.driver.node.settings.confirms

    asyncio.run(main())


def test_a_run_gets_its_outcomes_while_the_waits_of_the_one_before_end() -> None:
    """The numbers of messages begin again."""

    async def main() -> None:
        alice = make("alice", 1, 2, free_port())
        await alice.__aenter__()
        before = asyncio.ensure_future(alice.deliver("short-stored", b"first", to="bob"))
        await asyncio.sleep(0)
        await alice.__aexit__(None, None, None)
        async with asyncio.timeout(WAIT_S), alice:
            assert isinstance(await alice.deliver("short-stored", b"second", to="bob"), MessageExpired)
        await before

    asyncio.run(main())


def test_two_nodes_do_not_use_the_same_store(tmp_path: Path) -> None:
    """Both would send its messages, and each would delete what the other one wrote."""

    async def main() -> None:
        port = free_port()
        alice = make("alice", 1, 2, port, DirectoryStore(tmp_path / "outbox", 1 << 20))
        bob = make("bob", 2, 1, port, DirectoryStore(tmp_path / "outbox", 1 << 20))
        async with alice:
            with pytest.raises(OSError, match=f"{tmp_path / 'outbox'}: in use by another daemon or program"):
                await bob.__aenter__()
        async with bob:
            assert (await bob.send("stored", b"kept", to="alice")) is not None

    asyncio.run(main())


def test_settings_of_another_type_are_named() -> None:
    wrong: Any = {"name": "alice"}
    with pytest.raises(TypeError, match="settings: expected Settings, found dict"):
        Node(wrong)

    async def body(alice: Node, bob: Node) -> None:
        with pytest.raises(TypeError, match="settings: expected Settings, found dict"):
            alice.apply(wrong)

    run(body)


@pytest.mark.parametrize(
    ("fields", "error"),
    [
        ({}, "link: expected either interface or address, found neither"),
        ({"interface": "lo", "address": "127.0.4.1"}, "link: expected either interface or address, found both"),
        ({"address": "robot1"}, "link: expected an IP address, found 'robot1'"),
        ({"address": "fe80::1"}, "link: expected an address that is not link-local, found fe80::1"),
        ({"address": "127.0.4.1", "mtu": "1400"}, "link mtu: expected int, found '1400'"),
    ],
)
def test_a_link_that_cannot_be_opened_is_refused(fields: dict[str, Any], error: str) -> None:
    with pytest.raises((ValueError, TypeError), match=error):
        Node(Settings("alice", unkeyed=True), links=(LinkConfig(**fields),))


def test_a_single_link_in_place_of_a_sequence_is_named() -> None:
    link: Any = LinkConfig(address="127.0.4.1")
    with pytest.raises(TypeError, match="links: expected a tuple of LinkConfig, found LinkConfig"):
        Node(Settings("alice", unkeyed=True), links=link)


@pytest.mark.parametrize("dscp", [-5, 64, 300])
def test_a_code_point_has_six_bits(dscp: int) -> None:
    with pytest.raises(ValueError, match=f"urgent_dscp: expected 0 to 63, found {dscp}"):
        Node(Settings("alice", unkeyed=True), urgent_dscp=dscp)


def test_a_neighbor_needs_an_ip_address() -> None:
    """Nothing was ever sent to `localhost`, without a word."""
    neighbor = Neighbour(("localhost", 8700))
    with pytest.raises(ValueError, match="neighbor: expected an IP address, found 'localhost'"):
        Node(Settings("alice", unkeyed=True, neighbours=(neighbor,)))


def test_a_node_that_cannot_start_leaves_no_socket_and_no_timer() -> None:
    async def main() -> None:
        link = LinkConfig(address="127.0.4.1", broadcast=False)
        node = Node(Settings("alice", port=free_port(), unkeyed=True), links=(link,))
        soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
        last = os.open(os.devnull, os.O_RDONLY)
        os.close(last)
        resource.setrlimit(resource.RLIMIT_NOFILE, (last, hard))
        try:
            with pytest.raises(OSError, match="Too many open files"):
                await node.__aenter__()
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
        assert node.driver.closed

    asyncio.run(main())
