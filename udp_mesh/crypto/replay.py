"""Which packet numbers were already seen: the sliding window of RFC 6479 (blocks in a ring, so that nothing is
shifted).

`would_accept(number)` before the cipher (a replay costs no decryption), `accept(number)` after it succeeded.
"""

from __future__ import annotations

BLOCK_BITS = 64
WINDOW_BLOCKS = 64
WINDOW_PACKETS = (WINDOW_BLOCKS - 1) * BLOCK_BITS
"""4,032 packets: at a gigabit of full datagrams 45 ms of reordering, at 10 Mbit/s over 4 s; 512 B of memory per
channel."""


class ReplayWindow:
    """Equals a plain set of numbers, except that everything older than the window (or below its floor) counts as
    seen."""

    __slots__ = ("_blocks", "_floor", "largest")

    def __init__(self) -> None:
        self._blocks = [0] * WINDOW_BLOCKS
        self.largest = -1
        """Largest number accepted, -1 before the first."""
        self._floor = 0

    def would_accept(self, number: int) -> bool:
        top = self.largest
        if number < self._floor:
            return False
        if number > top:
            return True
        if (top >> 6) - (number >> 6) >= WINDOW_BLOCKS:
            return False
        return not (self._blocks[(number >> 6) % WINDOW_BLOCKS] >> (number & 63)) & 1

    def accept(self, number: int) -> bool:
        """Marks `number` as seen; False if it already was, or is too old to know."""
        block = number >> 6
        top = self.largest
        if number > top:
            if number < self._floor:
                return False
            top_block = top >> 6
            if block != top_block:
                for fresh in range(max(top_block + 1, block - WINDOW_BLOCKS + 1), block + 1):
                    self._blocks[fresh % WINDOW_BLOCKS] = 0
            self.largest = number
        elif not self.would_accept(number):
            return False
        self._blocks[block % WINDOW_BLOCKS] |= 1 << (number & 63)
        return True

    def raise_floor(self, number: int) -> None:
        """From now on nothing below `number` is accepted."""
        self._floor = max(self._floor, number)
