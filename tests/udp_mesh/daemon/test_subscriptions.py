"""Held messages go to programs as fast as these read them, and are read from the disk no faster."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Coroutine
from pathlib import Path
from typing import cast

from udp_mesh.core.events import MessageReceived, Receipt
from udp_mesh.core.subscriptions.messages import MAX_ENTRIES, Bounds, Subscription
from udp_mesh.daemon.api import Client
from udp_mesh.daemon.inbox import Inbox
from udp_mesh.daemon.outbox import DirectoryStore
from udp_mesh.daemon.subscriptions import Subscriptions

ITEMS = 1000


class Program:
    """A client's connection with room for some frames."""

    def __init__(self, room: int) -> None:
        self.room = room
        self.written_bytes = self.read_bytes = 0
        self.frames = 0

    def backlog_bytes(self) -> int:
        return self.written_bytes - self.read_bytes

    def send_encoded(self, frame: bytes) -> bool:
        if self.room == 0:
            return False
        self.room -= 1
        self.frames += 1
        self.written_bytes += len(frame)
        return True

    def read_all(self, room: int) -> None:
        self.read_bytes = self.written_bytes
        self.room = room


class Log:
    """The daemon's side of one log: it delivers again what is requested, one item after the other."""

    def __init__(self, folder: Path) -> None:
        self.requested: deque[int] = deque()
        self.requests = 0
        self.most_requested = 0
        self._numbers: dict[int, int] = {}
        self._receipts = 0
        self._tasks: set[asyncio.Task[None]] = set()
        self.inbox = Inbox(DirectoryStore(folder, 1 << 20), lambda _: None, self._request_again)
        self.subscriptions = Subscriptions(self.inbox, self._spawn, lambda _: 4)

    def _spawn(self, work: Coroutine[None, None, None]) -> None:
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    def _request_again(self, receipt: Receipt) -> None:
        self.requests += 1
        self.requested.append(self._numbers[receipt.message_id])
        self.most_requested = max(self.most_requested, len(self.requested))

    def deliver(self, number: int) -> None:
        self._receipts += 1
        self._numbers[self._receipts] = number
        receipt = Receipt(b"log", self._receipts)
        self.subscriptions.distribute(MessageReceived("spot", "artifact", "", b"data", 4, False, receipt, number))

    async def tick(self) -> None:
        """What the daemon does once a second, and the reads that follow."""
        self.inbox.take_read()
        self.subscriptions.pass_on_held()
        while self._tasks or self.requested:
            if self._tasks:
                await asyncio.gather(*self._tasks)
            if self.requested:
                self.deliver(self.requested.popleft())


def test_a_slow_program_does_not_make_a_log_read_its_backlog_again_and_again(tmp_path: Path) -> None:
    async def run() -> None:
        log, program = Log(tmp_path), Program(room=3)
        for number in range(1, ITEMS + 1):
            log.deliver(number)
        log.subscriptions.add(cast(Client, program), ["artifact"], acknowledge=False)
        for _ in range(10):
            await log.tick()
        assert program.frames == 3
        assert log.requests <= 100
        program.read_all(room=ITEMS)
        await log.tick()
        assert program.frames == ITEMS
        assert log.most_requested <= 100
        program.read_all(room=0)
        await log.tick()
        assert len(log.inbox) == 0
        log.inbox.close()

    asyncio.run(run())


def test_peers_are_announced_what_all_programs_read_together(tmp_path: Path) -> None:
    async def announced() -> list[list[Subscription]]:
        found: list[list[Subscription]] = []
        inbox = Inbox(DirectoryStore(tmp_path, 1 << 20), lambda _: None, lambda _: None)
        subscriptions = Subscriptions(inbox, lambda _: None, lambda _: 4, found.append)
        slow, fast, greedy = (cast(Client, Program(1)) for _ in range(3))
        subscriptions.add(slow, ["map", "video", "~mesh/conditions"], Bounds(1.0, 2.0))
        subscriptions.add(fast, ["video"], Bounds(5.0))
        await asyncio.sleep(0)
        subscriptions.remove(slow, ["map"])
        await asyncio.sleep(0)
        subscriptions.add(greedy, [f"topic{number}" for number in range(MAX_ENTRIES)])
        await asyncio.sleep(0)
        subscriptions.remove_client(greedy)
        subscriptions.remove_client(fast)
        await asyncio.sleep(0)
        return found

    together, without_map, too_many, rest = asyncio.run(announced())
    assert together == [Subscription("map", Bounds(1.0, 2.0)), Subscription("video", Bounds(5.0, None))]
    assert without_map == together[1:]
    assert too_many == [Subscription("*")]
    assert rest == [Subscription("video", Bounds(1.0, 2.0))]
