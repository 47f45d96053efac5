"""Replay protection: the sliding window of RFC 6479 over packet numbers (blocks in a ring, so that nothing is shifted).

Call `would_accept(number)` before decrypting (a replay costs no decryption), `accept(number)` after it succeeded.
"""

from __future__ import annotations

BLOCK_BITS = 64
WINDOW_BLOCKS = 64
WINDOW_PACKETS = (WINDOW_BLOCKS - 1) * BLOCK_BITS
"""4,032 packets: 45 ms of reordering with full datagrams at a gigabit, over 4 s at 10 Mbit/s; 512 B of memory per
channel."""

AGE_STEP_S = 5.0
"""Half of the maximum age of an accepted datagram (`datagram_age.ACCEPT_AGE_S`)."""


class ReplayWindow:
    """Equals a plain set of numbers, except that everything older than the window (or below its floor) counts as
    seen."""

    __slots__ = ("_aged_at", "_blocks", "_floor", "_newer", "_older", "largest")

    def __init__(self) -> None:
        self._blocks = [0] * WINDOW_BLOCKS
        self.largest = -1
        """Largest number accepted, -1 before the first."""
        self._floor = 0
        self._aged_at: float | None = None
        self._older = self._newer = -1
        """The largest number one and two steps of `age` ago."""

    @property
    def floor(self) -> int:
        """All numbers below it count as seen."""
        return self._floor

    @property
    def next_new(self) -> int:
        """No number from this one on was accepted or ruled out."""
        return max(self.largest + 1, self._floor)

    def age(self, now: float, largest: int = -1) -> None:
        """Call periodically: everything below the largest number of two steps (10 s) ago counts as seen. `largest` is
        that of the channel's windows for other keys.

        An attacker may replay a datagram that was lost. After that time it is worthless: its fragments were
        retransmitted under new numbers long before.
        """
        if self._aged_at is None:
            self._aged_at = now
        elif now - self._aged_at >= AGE_STEP_S:
            self._aged_at = now
            self._floor = max(self._floor, self._older + 1)
            self._older, self._newer = self._newer, max(self.largest, largest)

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
        """Mark `number` as seen. False if it already was, or is older than the window."""
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

    def accepted_share(self, first: int, newest: int, least: int) -> float | None:
        """The share of the numbers up to the largest one that was accepted, of at most the `newest` ones and of those
        from `first` on; None if these are fewer than `least`."""
        start = max(first, self.largest - min(newest, WINDOW_PACKETS) + 1)
        count = self.largest - start + 1
        if count < least:
            return None
        accepted = sum(
            (self._blocks[(number >> 6) % WINDOW_BLOCKS] >> (number & 63)) & 1
            for number in range(start, self.largest + 1)
        )
        return accepted / count

    def raise_floor(self, number: int) -> None:
        """Reject all numbers below `number` from now on."""
        self._floor = max(self._floor, number)
