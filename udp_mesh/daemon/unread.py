"""What a program in this process has not read yet: messages and events, bounded in number and bytes."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import AsyncIterator, Callable, Iterator
from typing import Generic, TypeVar

from udp_mesh.core.events import MessageReceived, Receipt

T = TypeVar("T")

MAX_UNREAD = 65_536
"""Messages, or events; beyond it, the oldest is dropped and counted."""
MAX_UNREAD_BYTES = 256 << 20
"""The payloads of the messages together: several of the largest."""
RETRY_S = 5.0
"""Until a message with a receipt that found no room is requested from its sender again."""


class Unread(Generic[T]):
    """A bounded queue, and the wait for its next entry."""

    def __init__(self) -> None:
        self._entries: deque[T] = deque()
        self._arrived = asyncio.Event()
        self.dropped = 0
        """Entries that were dropped for later ones."""
        self.closed = False

    def __iter__(self) -> Iterator[T]:
        return iter(self._entries)

    def add(self, entry: T) -> None:
        if len(self._entries) >= MAX_UNREAD:
            self._entries.popleft()
            self.dropped += 1
        self._entries.append(entry)
        self._arrived.set()

    def close(self) -> None:
        """No further entry comes: those that wait stop once they have read the last one."""
        self.closed = True
        self._arrived.set()

    def take(self) -> T | None:
        return self._entries.popleft() if self._entries else None

    async def wait(self) -> bool:
        """Waits until there is an entry. False if none will come."""
        while not self._entries:
            if self.closed:
                return False
            self._arrived.clear()
            await self._arrived.wait()
        return True


class UnreadMessages(Unread[MessageReceived]):
    """A message with a receipt is kept by its sender until `confirm` is called: when it is read. It is not dropped;
    without room for it, `postpone` is called, so that it comes again later."""

    def __init__(self, confirm: Callable[[Receipt], None], postpone: Callable[[Receipt], None]) -> None:
        super().__init__()
        self._confirm, self._postpone = confirm, postpone
        self.bytes = 0

    def add(self, entry: MessageReceived) -> None:
        size = len(entry.payload)
        while self._entries and not self._has_room(size):
            oldest = next((at for at, waiting in enumerate(self._entries) if waiting.receipt is None), None)
            if oldest is None:
                break
            self.bytes -= len(self._entries[oldest].payload)
            del self._entries[oldest]
            self.dropped += 1
        if self._entries and not self._has_room(size):
            if entry.receipt is None:
                self.dropped += 1
            else:
                self._postpone(entry.receipt)
            return
        self.bytes += size
        self._entries.append(entry)
        self._arrived.set()

    def take(self) -> MessageReceived | None:
        entry = super().take()
        if entry is not None:
            self.bytes -= len(entry.payload)
            if entry.receipt is not None and not self.closed:
                self._confirm(entry.receipt)
        return entry

    def _has_room(self, size: int) -> bool:
        return len(self._entries) < MAX_UNREAD and self.bytes + size <= MAX_UNREAD_BYTES


class Reading(AsyncIterator[T]):
    """Reads until nothing more comes. A wait that is canceled, such as by a timeout, loses no entry, and the next one
    continues; a generator would end there."""

    def __init__(self, unread: Unread[T], check: Callable[[], None]) -> None:
        """`check` raises if the calling program may not read here."""
        self._unread = unread
        self._check = check

    async def __anext__(self) -> T:
        self._check()
        while await self._unread.wait():
            entry = self._unread.take()
            if entry is not None:
                return entry
        raise StopAsyncIteration
