"""What a program does not read is bounded; what its sender keeps is not lost."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator

import pytest

from udp_mesh.core.events import MessageReceived, Receipt
from udp_mesh.daemon import unread
from udp_mesh.daemon.unread import Reading, Unread, UnreadMessages


def message(number: int, size: int = 10, *, kept: bool = False) -> MessageReceived:
    receipt = Receipt(b"boot", number) if kept else None
    return MessageReceived("alice", "map", "", b"%d" % number + bytes(size - 1), 7, False, receipt)


def numbers(found: Iterator[MessageReceived]) -> list[int]:
    return [int(one.payload[:1]) for one in found]


class Program:
    def __init__(self) -> None:
        self.confirmed: list[int] = []
        self.postponed: list[int] = []
        self.unread = UnreadMessages(
            lambda receipt: self.confirmed.append(receipt.message_id),
            lambda receipt: self.postponed.append(receipt.message_id),
        )


@pytest.fixture(autouse=True)
def limits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(unread, "MAX_UNREAD", 4)
    monkeypatch.setattr(unread, "MAX_UNREAD_BYTES", 100)


def test_the_oldest_message_makes_room_in_number_and_in_bytes() -> None:
    program = Program()
    for number in range(6):
        program.unread.add(message(number))
    assert numbers(iter(program.unread)) == [2, 3, 4, 5]
    program.unread.add(message(6, 75))
    assert numbers(iter(program.unread)) == [4, 5, 6]
    assert (program.unread.dropped, program.unread.bytes) == (4, 95)


def test_a_message_that_alone_exceeds_the_limit_is_kept() -> None:
    program = Program()
    program.unread.add(message(0))
    program.unread.add(message(1, 500))
    assert numbers(iter(program.unread)) == [1]


def test_a_message_that_its_sender_keeps_is_postponed_rather_than_dropped() -> None:
    program = Program()
    program.unread.add(message(0, kept=True))
    program.unread.add(message(1))
    for number in (2, 3, 4, 5):
        program.unread.add(message(number, kept=True))
    program.unread.add(message(6))
    assert numbers(iter(program.unread)) == [0, 2, 3, 4]
    assert (program.postponed, program.unread.dropped) == ([5], 2)
    assert program.confirmed == []
    assert [program.unread.take() is not None for _ in range(4)] == [True] * 4
    assert program.confirmed == [0, 2, 3, 4]
    assert program.unread.bytes == 0


def test_what_is_read_after_the_end_is_not_confirmed() -> None:
    program = Program()
    program.unread.add(message(0, kept=True))
    program.unread.close()

    async def read() -> list[MessageReceived]:
        return [one async for one in Reading(program.unread, lambda: None)]

    assert numbers(iter(asyncio.run(read()))) == [0]
    assert program.confirmed == []


def test_several_readers_get_each_entry_once() -> None:
    async def main() -> None:
        events: Unread[int] = Unread()

        async def read() -> list[int]:
            return [one async for one in Reading(events, lambda: None)]

        readers = [asyncio.ensure_future(read()) for _ in range(3)]
        for number in range(4):
            await asyncio.sleep(0)
            events.add(number)
        events.close()
        found = await asyncio.gather(*readers)
        assert sorted(one for several in found for one in several) == [0, 1, 2, 3]

    asyncio.run(main())
