"""Datagrams of other keys: which are reported. One allowance over all addresses, since addresses are free.

An address is reported once a minute, any of them `AT_ONCE` times in a row and then once per `EVERY_S`. The number of
datagrams not reported meanwhile comes with the next event, at the latest `EVERY_S` after the last of them.
"""

from collections import OrderedDict

from udp_mesh.core.events import KeyMismatch
from udp_mesh.core.settings import Address

AGAIN_S = 60.0
"""The same address is reported once in this time."""

AT_ONCE = 8
"""Addresses reported in a row: a team that missed a rotation is seen at a glance."""

EVERY_S = 10.0
"""Then one event per so many seconds: a flood of 20,000 a second fills no log."""

REMEMBERED = 256
"""Addresses whose unknown key was reported: a flood of them must not grow memory."""


class KeyMismatchLimiter:
    """What of unknown keys is reported; `None` where nothing is to be said now."""

    __slots__ = ("_at", "_last", "_left", "_reported", "more")

    def __init__(self) -> None:
        self._reported: OrderedDict[Address, float] = OrderedDict()
        self._left = float(AT_ONCE)
        self._at = float("-inf")
        self._last: tuple[Address, str] | None = None
        self.more = 0
        """Datagrams from addresses not reported yet."""

    def seen(self, source: Address, link: str, now: float) -> KeyMismatch | None:
        """A datagram of an unknown key came."""
        if now - self._reported.get(source, float("-inf")) < AGAIN_S:
            return None
        if not self._take(now):
            self.more += 1
            self._last = (source, link)
            return None
        self._reported[source] = now
        self._reported.move_to_end(source)
        while len(self._reported) > REMEMBERED:
            self._reported.popitem(last=False)
        return self._event(source, link)

    def rest(self, now: float) -> KeyMismatch | None:
        """To be called now and then: what was not reported yet."""
        if self._last is None or not self._take(now):
            return None
        source, link = self._last
        self.more -= 1
        return self._event(source, link)

    def _event(self, source: Address, link: str) -> KeyMismatch:
        event = KeyMismatch(source, link, self.more)
        self.more, self._last = 0, None
        return event

    def _take(self, now: float) -> bool:
        if self._at != float("-inf"):
            self._left = min(AT_ONCE, self._left + max(0.0, now - self._at) / EVERY_S)
        self._at = now
        if self._left < 1:
            return False
        self._left -= 1
        return True
