"""What a daemon reports as delivered outlives programs that are down, and daemons that are killed."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.udp_mesh.daemon.disks import standing_disk
from tests.udp_mesh.daemon.processes import (
    RunningDaemon,
    collect,
    configuration,
    outcomes,
    poll,
    two_daemons,
    wait_online,
)
from tests.udp_mesh.links.sockets import free_port
from udp_mesh.client import MeshError

KEPT = 'kept = { priority = 5, outbox = "all", outbox_on_disk = true }'


@pytest.fixture(scope="module")
def pair() -> Iterator[tuple[RunningDaemon, RunningDaemon]]:
    with two_daemons(KEPT) as running:
        yield running


def publish(alice: RunningDaemon, *payloads: bytes) -> None:
    """Publish and wait until all of them are reported as delivered."""
    with alice.client() as sender:
        for payload in payloads:
            sender.publish("kept", payload, to="bob", notify=True)
        assert set(outcomes(sender, len(payloads)).values()) == {"delivered"}


def held(daemon: RunningDaemon) -> int:
    return len(list((daemon.folder / daemon.name / "inbox").glob("*.message")))


def test_messages_delivered_without_a_subscriber_survive_a_daemon_kill(
    pair: tuple[RunningDaemon, RunningDaemon],
) -> None:
    alice, bob = pair
    payloads = [b"%d" % number for number in range(20)]
    publish(alice, *payloads)
    bob.kill()
    assert held(bob) == 20
    bob.start()
    with bob.client() as program:
        assert program.request("status")["inbox_messages"] == 20
        program.subscribe("kept")
        assert [message.payload for message in collect(program, 20)] == payloads
    poll(lambda: held(bob) == 0, "nothing is held")
    with bob.client() as program:
        program.subscribe("kept")
        assert list(program.messages(0.5)) == []
    wait_online(alice, "bob")


def test_a_subscribed_program_receives_messages_immediately(pair: tuple[RunningDaemon, RunningDaemon]) -> None:
    alice, bob = pair
    with bob.client() as program:
        program.subscribe("kept")
        publish(alice, b"one", bytes(1_000_000))
        first, second = collect(program, 2)
        assert (first.payload, first.receipt, len(second.payload)) == (b"one", None, 1_000_000)
        poll(lambda: held(bob) == 0, "nothing is held")


def test_a_message_goes_to_the_next_program_until_one_acknowledges_it(
    pair: tuple[RunningDaemon, RunningDaemon],
) -> None:
    alice, bob = pair
    with bob.client() as crashing:
        crashing.subscribe("kept", acknowledge=True)
        publish(alice, b"first", b"second")
        (message, _) = collect(crashing, 2)
        assert message.payload == b"first"
        assert message.receipt is not None
        assert crashing.acknowledge(message.receipt) == 1
        assert crashing.acknowledge(message.receipt) == 0
    with bob.client() as program, bob.client() as other:
        program.subscribe("kept", acknowledge=True)
        (message,) = collect(program, 1)
        assert message.payload == b"second"
        assert message.receipt is not None
        assert other.acknowledge(message.receipt) == 0
        assert program.acknowledge(message.receipt) == 1
        with pytest.raises(MeshError, match="receipts: expected a list of numbers"):
            program.request("acknowledge", receipts="all")
    poll(lambda: held(bob) == 0, "nothing is held")


@contextmanager
def with_a_full_disk() -> Iterator[tuple[RunningDaemon, RunningDaemon]]:
    """Bob's inbox has no room."""
    with tempfile.TemporaryDirectory(prefix="udp-mesh-") as path:
        folder, port = Path(path), free_port()
        alice = RunningDaemon(folder, "alice", configuration(folder, "alice", 1, [2], port, topics=KEPT))
        text = configuration(folder, "bob", 2, [1], port, topics=KEPT, more="outbox_disk_bytes = 100")
        with alice, RunningDaemon(folder, "bob", text) as bob:
            wait_online(alice, "bob")
            wait_online(bob, "alice")
            yield alice, bob


def test_a_message_neither_stored_nor_read_is_not_delivered_until_resent() -> None:
    with with_a_full_disk() as (alice, bob), alice.client() as sender:
        sender.publish("kept", bytes(500), to="bob", notify=True)
        poll(lambda: "outbox-full" in bob.log.read_text(), "bob has no room")
        assert sender.next_frame(0.5) is None
        with bob.client() as program:
            program.subscribe("kept")
            assert len(collect(program, 1)[0].payload) == 500
            assert set(outcomes(sender, 1).values()) == {"delivered"}


def test_a_daemon_that_is_stopped_confirms_what_it_has_received() -> None:
    """Otherwise its senders send that again when it is back, and its programs get it twice."""
    with (
        two_daemons(KEPT) as (alice, bob),
        standing_disk(bob.folder / "bob" / "inbox", 0) as go_on,
        alice.client() as sender,
        ThreadPoolExecutor(1) as stopping,
    ):
        # The disk hangs at the first message, whose file is a pipe and cannot be synchronized; the second one waits.
        _, number = (sender.publish("kept", payload, to="bob", notify=True) for payload in (b"hangs", b"waits"))
        with bob.client() as program:
            poll(lambda: program.request("status")["inbox_messages"] == 2, "the messages at bob")
        code = stopping.submit(bob.stop)
        poll(lambda: not bob.socket.exists(), "the end of bob's socket")
        go_on()
        assert outcomes(sender, 1) == {number: "delivered"}
        assert code.result() == 0
