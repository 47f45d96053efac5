"""The daemon's thread for long computations: the loop runs meanwhile, and hears of the end."""

import asyncio
import logging
import random
import threading
from dataclasses import replace
from functools import partial

import pytest

from tests.udp_mesh.daemon.test_api_node import TOPICS, run
from tests.udp_mesh.links.sockets import WAIT_S
from udp_mesh import Node
from udp_mesh.core.events import MessageDelivered
from udp_mesh.core.versions import encoding
from udp_mesh.daemon.background import BackgroundThread


def wait_for(event: threading.Event) -> None:
    assert event.wait(WAIT_S)


def test_the_loop_runs_while_the_work_does_and_is_woken_after_it() -> None:
    async def main() -> None:
        woken, go_on = asyncio.Event(), threading.Event()
        background = BackgroundThread(asyncio.get_running_loop(), woken.set)
        is_done = background(partial(wait_for, go_on))
        await asyncio.sleep(0)
        assert not is_done()
        assert not woken.is_set()
        go_on.set()
        await asyncio.wait_for(woken.wait(), WAIT_S)
        assert is_done()
        background.close()

    asyncio.run(main())


def test_work_that_fails_is_logged_and_done(caplog: pytest.LogCaptureFixture) -> None:
    def work() -> None:
        raise MemoryError("no room")

    async def main() -> None:
        woken = asyncio.Event()
        background = BackgroundThread(asyncio.get_running_loop(), woken.set)
        is_done = background(work)
        await asyncio.wait_for(woken.wait(), WAIT_S)
        assert is_done()
        background.close()

    with caplog.at_level(logging.ERROR):
        asyncio.run(main())
    assert "background-failed error=MemoryError('no room')" in caplog.text


def test_work_that_ends_after_its_loop_disturbs_nothing(caplog: pytest.LogCaptureFixture) -> None:
    go_on = threading.Event()

    async def main() -> BackgroundThread:
        background = BackgroundThread(asyncio.get_running_loop(), lambda: None)
        background(partial(wait_for, go_on))
        background.close()
        return background

    background = asyncio.run(main())
    go_on.set()
    background._threads.shutdown(wait=True)
    assert caplog.text == ""


def test_urgent_messages_are_delivered_while_the_base_of_a_difference_is_indexed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    go_on, began = threading.Event(), threading.Event()
    index = encoding._Beginning.__call__

    def slowly(self: encoding._Beginning) -> None:
        began.set()
        go_on.wait(WAIT_S)
        index(self)

    monkeypatch.setattr(encoding._Beginning, "__call__", slowly)
    first = random.Random(1).randbytes(2 * encoding.BACKGROUND_FROM_BYTES)
    second = first[:1000] + b"changed" + first[1000:]

    async def body(alice: Node, bob: Node) -> None:
        for node in (alice, bob):
            topics = tuple(replace(topic, delta=topic.name == "map") for topic in TOPICS)
            node.driver.apply(replace(node.driver.node.settings, topics=topics))
        assert isinstance(await alice.deliver("map", first, to="bob"), MessageDelivered)
        delivery = asyncio.create_task(alice.deliver("map", second, to="bob"))
        assert await asyncio.to_thread(began.wait, WAIT_S)
        assert isinstance(await alice.deliver("status", b"stop", to="bob"), MessageDelivered)
        assert not delivery.done()
        go_on.set()
        assert isinstance(await delivery, MessageDelivered)
        (counters,) = (one.counters for one in alice.driver.node.versions() if one.topic == "map")
        assert counters.differences_sent == 1

    try:
        run(body)
    finally:
        go_on.set()
