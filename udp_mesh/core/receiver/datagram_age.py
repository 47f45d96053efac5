"""How old an opened datagram is, by its sender's own clock: distinguishes a recording from a slow datagram.

A replay window knows which numbers came, not when a number that never came was sent. A peer that can says its clock in
what it sends (`Sent`, a heartbeat's extension). The least difference to our clock ever seen is that of a datagram which
came straight; one whose difference is larger by `ACCEPT_AGE_S` was held back that long. No clock is set or compared
with another: only how fast they run matters. A clock that stood still (its computer slept) makes everything look old;
a ping that is answered sets it right (`paths`).
"""

ACCEPT_AGE_S = 10.0
"""Longer than a route of 800 ms, a cut of some seconds or a full queue of a slow radio holds a datagram back; silence
of this length takes a peer offline. What is older comes again under a new number, if it still matters to its sender."""

CHALLENGE_AFTER_S = ACCEPT_AGE_S / 2
"""Without a date so long, under a bulk whose pieces have none, the sender is asked: time enough for some questions."""

MAX_CLOCK_DRIFT = 1e-3
"""By which two monotonic clocks may drift apart: 100 ppm each, and 500 ppm while NTP slews one."""

_CLOCK_BITS = 32


def clock_ms(now: float) -> int:
    """Our clock as `Sent` carries it."""
    return int(now * 1000) & 0xFFFFFFFF


class Freshness:
    """What is known of one boot's clock, in its milliseconds and our seconds."""

    __slots__ = ("_offset_ms", "_set_at", "fresh_at", "trusted_until")

    def __init__(self) -> None:
        self._offset_ms: int | None = None
        self._set_at = 0.0
        self.fresh_at = float("-inf")
        """When something came last that cannot have been a recording."""
        self.trusted_until = float("-inf")
        """Until then what has no date needs no look."""

    def lateness_s(self, clock: int, now: float) -> float:
        """Seconds for which a datagram sent at `clock` was held back; at most `ACCEPT_AGE_S` is fresh."""
        offset_ms = clock_ms(now) - clock & 0xFFFFFFFF
        if self._offset_ms is None:
            self._set(offset_ms, now)
            return 0.0
        late_ms = _signed(offset_ms - self._offset_ms)
        if late_ms <= (now - self._set_at) * MAX_CLOCK_DRIFT * 1000:
            self._set(offset_ms, now)
            return 0.0
        late_s = late_ms / 1000
        if late_s <= ACCEPT_AGE_S:
            self._is_fresh(now)
        return late_s

    def confirm(self, now: float, clock: int | None = None) -> None:
        """What just came answers a question of ours; if dated, its clock is right, whatever was known of it."""
        self._is_fresh(now)
        if clock is not None:
            self._set(clock_ms(now) - clock & 0xFFFFFFFF, now)

    def _set(self, offset_ms: int, now: float) -> None:
        self._offset_ms, self._set_at = offset_ms, now
        self._is_fresh(now)

    def _is_fresh(self, now: float) -> None:
        self.fresh_at = now
        self.trusted_until = now + CHALLENGE_AFTER_S


def _signed(difference: int) -> int:
    half = 1 << (_CLOCK_BITS - 1)
    return (difference + half & 0xFFFFFFFF) - half
