"""The age of an opened datagram by its sender's clock, which distinguishes a replayed datagram from a slow one.

A replay window knows which numbers arrived, but not when a number that never arrived was sent. A capable peer puts its
clock into what it sends (`Sent`, a heartbeat's extension). The smallest difference to our clock ever seen belongs to a
datagram that came without delay; one whose difference is larger by `ACCEPT_AGE_S` was delayed that long. Only clock
rates matter: no clock is set or compared. A clock that stood still (its computer was suspended) makes everything look
old; an answered ping corrects that (see `path_validation`).
"""

ACCEPT_AGE_S = 10.0
"""Longer than a route of 800 ms, an outage of some seconds or a full queue of a slow radio delays a datagram;
silence of this length takes a peer offline. Older data is retransmitted under a new number if it still matters to
its sender."""

CHALLENGE_AFTER_S = ACCEPT_AGE_S / 2
"""After this long without a timestamp, as in bulk fragments, the sender is challenged: enough time for several
attempts."""

MAX_CLOCK_DRIFT = 1e-3
"""Maximum drift of two monotonic clocks: 100 ppm each, and 500 ppm while NTP slews one."""

_CLOCK_BITS = 32


def clock_ms(now: float) -> int:
    """Our clock as carried by `Sent`."""
    return int(now * 1000) & 0xFFFFFFFF


ECHO_UNIT_MS = 256
"""Unit of a clock that a heartbeat echoes: three bytes of it wrap together with the clock."""

_ECHO_MASK = 0xFFFFFF


def clock_echo(clock: int) -> int:
    """A heartbeat's clock as its receiver echoes it."""
    return clock // ECHO_UNIT_MS


def echo_age_s(echo: int, now: float) -> float:
    """Seconds since our clock was what a peer echoes, to within a unit."""
    return (clock_echo(clock_ms(now)) - echo & _ECHO_MASK) * ECHO_UNIT_MS / 1000


class Freshness:
    """Measurements of one boot's clock, in its milliseconds and our seconds."""

    __slots__ = (
        "_offset_ms",
        "_set_at",
        "broadcasts_resumed",
        "confirmed",
        "data_resumed",
        "fresh_at",
        "trusted_until",
    )

    def __init__(self) -> None:
        self._offset_ms: int | None = None
        self._set_at = 0.0
        self.confirmed = False
        """Its clock is compared with that of a datagram which was no recording."""
        self.fresh_at = float("-inf")
        """When something that cannot be a replay last came."""
        self.data_resumed = self.broadcasts_resumed = False
        """It is heard again after a silence of more than `ACCEPT_AGE_S`, and no number shows yet what is from before: a
        datagram without a timestamp may be."""
        self.trusted_until = float("-inf")
        """Until then, datagrams without a timestamp are accepted without a check."""

    def lateness_s(self, clock: int, now: float) -> float:
        """Seconds by which a datagram sent at `clock` was delayed; up to `ACCEPT_AGE_S` it is fresh."""
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

    def late_by_s(self, clock: int, now: float) -> float:
        """The same without any effect; infinite while no clock is known."""
        if self._offset_ms is None:
            return float("inf")
        return max(0.0, _signed((clock_ms(now) - clock & 0xFFFFFFFF) - self._offset_ms) / 1000)

    def confirm(self, now: float, clock: int | None = None) -> None:
        """Record a proof that the boot is there now, such as the answer to a challenge. Its timestamp, if any, replaces
        what was known about the clock."""
        self.confirmed = True
        self._is_fresh(now)
        if clock is not None:
            self._set(clock_ms(now) - clock & 0xFFFFFFFF, now)

    def on_data_floor(self, now: float) -> None:
        """The replay window rules out what was sent before the silence."""
        self.data_resumed = False
        self._is_fresh(now)

    def _set(self, offset_ms: int, now: float) -> None:
        self._offset_ms, self._set_at = offset_ms, now
        self._is_fresh(now)

    def _is_fresh(self, now: float) -> None:
        if ACCEPT_AGE_S < now - self.fresh_at < float("inf"):
            self.data_resumed = self.broadcasts_resumed = True
        self.fresh_at = now
        self.trusted_until = float("-inf") if self.data_resumed else now + CHALLENGE_AFTER_S


def _signed(difference: int) -> int:
    half = 1 << (_CLOCK_BITS - 1)
    return (difference + half & 0xFFFFFFFF) - half
