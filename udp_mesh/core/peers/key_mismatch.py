"""Rate-limit reports of datagrams sealed with unknown keys. All addresses share one token bucket: they can be forged.

An address is reported at most once a minute; all addresses together `BURST` times in a row, then once per
`REFILL_INTERVAL_S`. Datagrams not reported are counted in the next event, which follows at most `REFILL_INTERVAL_S`
after the last of them.
"""

from collections import OrderedDict

from udp_mesh.core.events import KeyMismatch
from udp_mesh.core.settings import Address

REPORT_INTERVAL_S = 60.0
"""Minimum time between two reports of the same address."""

BURST = 8
"""Addresses reported in a row, so that a team that missed a key rotation is reported completely."""

REFILL_INTERVAL_S = 10.0
"""After that, one event per interval: a flood of 20,000 datagrams a second fills no log."""

MAX_REMEMBERED = 256
"""Reported addresses remembered; bounds memory during a flood."""


class KeyMismatchLimiter:
    """Decides which datagrams of unknown keys are reported; returns None if none is to be reported now."""

    __slots__ = ("_at", "_last", "_reported", "_tokens", "more")

    def __init__(self) -> None:
        self._reported: OrderedDict[Address, float] = OrderedDict()
        self._tokens = float(BURST)
        self._at = float("-inf")
        self._last: tuple[Address, str] | None = None
        self.more = 0
        """Datagrams from addresses not reported yet."""

    def on_mismatch(self, source: Address, link: str, now: float) -> KeyMismatch | None:
        """Process a datagram sealed with an unknown key."""
        if now - self._reported.get(source, float("-inf")) < REPORT_INTERVAL_S:
            return None
        if not self._take_token(now):
            self.more += 1
            self._last = (source, link)
            return None
        self._reported[source] = now
        self._reported.move_to_end(source)
        while len(self._reported) > MAX_REMEMBERED:
            self._reported.popitem(last=False)
        return self._event(source, link)

    def flush(self, now: float) -> KeyMismatch | None:
        """Report what was not reported yet. Call periodically."""
        if self._last is None or not self._take_token(now):
            return None
        source, link = self._last
        self.more -= 1
        return self._event(source, link)

    def _event(self, source: Address, link: str) -> KeyMismatch:
        event = KeyMismatch(source, link, self.more)
        self.more, self._last = 0, None
        return event

    def _take_token(self, now: float) -> bool:
        if self._at != float("-inf"):
            self._tokens = min(BURST, self._tokens + max(0.0, now - self._at) / REFILL_INTERVAL_S)
        self._at = now
        if self._tokens < 1:
            return False
        self._tokens -= 1
        return True
