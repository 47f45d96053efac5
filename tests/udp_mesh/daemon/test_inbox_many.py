"""An inbox with many messages costs no more for each than one with few. Costs are counted, not timed."""

from __future__ import annotations

import asyncio
import sys
import tracemalloc
from collections.abc import Callable, Coroutine
from concurrent.futures import Future
from pathlib import Path
from types import FrameType
from typing import Any, cast

import pytest

from tests.udp_mesh.disk import Disk
from udp_mesh.core.events import MessageReceived, Receipt
from udp_mesh.core.interfaces import StoredMessage
from udp_mesh.daemon.api import Client
from udp_mesh.daemon.inbox import Inbox
from udp_mesh.daemon.outbox import DirectoryStore
from udp_mesh.daemon.subscriptions import Subscriptions

MANY = 1000


class QuickDisk(Disk):
    """A disk that takes everything at once. What it does not have cannot be removed."""

    needs_flush = True

    def remove(self, key: int) -> None:
        del self.kept[key]

    def read(self, key: int) -> StoredMessage | None:
        return self.kept.get(key)

    def flush(self) -> Future[None]:
        done: Future[None] = Future()
        done.set_result(None)
        return done


class Program:
    """A client that reads and acknowledges on command."""

    def __init__(self) -> None:
        self.written_bytes = self.read_bytes = 0
        self.room = 1 << 62
        self.asked = 0
        self.payloads: list[bytes] = []

    def backlog_bytes(self) -> int:
        self.asked += 1
        return self.written_bytes - self.read_bytes

    def send_encoded(self, frame: bytes) -> bool:
        if self.backlog_bytes() + len(frame) > self.room:
            return False
        self.written_bytes += len(frame)
        self.payloads.append(frame[-8:])
        return True


class Robot:
    def __init__(self) -> None:
        self.disk = QuickDisk()
        self.confirmed: list[Receipt] = []
        self.inbox = Inbox(cast(DirectoryStore, self.disk), self.confirmed.append, lambda _: None)
        self._tasks: set[asyncio.Task[None]] = set()
        self.subscriptions = Subscriptions(self.inbox, self._spawn, lambda _: 4)
        self._received = 0

    def _spawn(self, work: Coroutine[None, None, None]) -> None:
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def settle(self) -> None:
        while self._tasks:
            await asyncio.gather(*self._tasks)

    async def receive(self, count: int) -> None:
        for _ in range(count):
            payload = b"%8d" % self._received
            receipt = Receipt(b"boot", self._received)
            self._received += 1
            self.subscriptions.distribute(MessageReceived("spot", "kept", "", payload, 4, False, receipt))
            await self.settle()

    def subscribe(self, *, acknowledge: bool = False) -> Program:
        program = Program()
        self.subscriptions.add(cast(Client, program), ["kept"], acknowledge=acknowledge)
        return program


async def lines_of(work: Callable[[], Coroutine[Any, Any, None]]) -> int:
    """How many lines of the inbox and of the subscriptions `work` runs."""
    count = 0

    def on_line(_frame: FrameType, event: str, _: object) -> Any:
        nonlocal count
        count += event == "line"
        return on_line

    def on_call(frame: FrameType, _event: str, _: object) -> Any:
        return on_line if frame.f_code.co_filename.endswith(("inbox.py", "subscriptions.py")) else None

    before = sys.gettrace()
    sys.settrace(on_call)
    try:
        await work()
    finally:
        sys.settrace(before)
    return count


@pytest.mark.parametrize("reader", ["none", "does not read", "does not acknowledge"])
def test_a_message_costs_the_same_however_many_are_held(reader: str) -> None:
    async def main() -> None:
        robot = Robot()
        if reader != "none":
            robot.subscribe(acknowledge=reader == "does not acknowledge")
        first = await lines_of(lambda: robot.receive(50))
        await robot.receive(MANY)
        last = await lines_of(lambda: robot.receive(50))
        assert len(robot.inbox) == MANY + 100
        assert len(robot.confirmed) == MANY + 100
        assert last < 1.5 * first

    asyncio.run(main())


def test_a_client_that_leaves_costs_the_same_however_many_are_held() -> None:
    async def main() -> None:
        robot = Robot()

        async def leave() -> None:
            robot.subscriptions.remove_client(cast(Client, Program()))
            await robot.settle()

        await robot.receive(1)
        first = await lines_of(leave)
        await robot.receive(MANY)
        assert await lines_of(leave) < 1.5 * first

    asyncio.run(main())


def test_a_program_without_room_is_not_asked_for_each_held_message() -> None:
    async def main() -> None:
        robot = Robot()
        await robot.receive(MANY)
        program = robot.subscribe()
        program.room = 2_000
        await robot.settle()
        sent = len(program.payloads)
        assert 0 < sent < 50
        assert program.asked < 5 * sent
        program.room, program.read_bytes = 1 << 62, program.written_bytes
        robot.inbox.take_read()
        robot.subscriptions.pass_on_held()
        await robot.settle()
        assert program.payloads == [b"%8d" % number for number in range(MANY)]

    asyncio.run(main())


def test_what_one_program_read_waits_for_the_acknowledgment_of_another() -> None:
    async def main() -> None:
        robot = Robot()
        reading, acknowledging = robot.subscribe(), robot.subscribe(acknowledge=True)
        await robot.receive(3)
        reading.read_bytes = reading.written_bytes
        robot.inbox.take_read()
        assert len(robot.inbox) == 3
        assert robot.inbox.acknowledge(cast(Client, acknowledging), 1)
        assert sorted(robot.disk.kept) == [0, 2]
        robot.subscriptions.remove_client(cast(Client, acknowledging))
        assert not robot.disk.kept
        assert len(robot.inbox) == 0

    asyncio.run(main())


def test_held_messages_are_not_in_memory_after_a_start(tmp_path: Path) -> None:
    store = DirectoryStore(tmp_path, 1 << 30)
    for key in range(20):
        store.put(StoredMessage(key, "spot", "kept", "", bytes(1_000_000), None))
    store.close()
    inbox = Inbox(DirectoryStore(tmp_path, 1 << 30), lambda _: None, lambda _: None)
    tracemalloc.start()
    inbox.load()
    _, peak_bytes = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert len(inbox) == 20
    assert peak_bytes < 6_000_000
