"""Announces to peers which items this node holds: changes soon, everything at a meeting and once a minute."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence

from udp_mesh.core.events import Rejected
from udp_mesh.core.logs.item import LogKey
from udp_mesh.core.logs.knowledge import PeerView
from udp_mesh.core.logs.messages import CONTROL_TOPIC, MAX_ENTRIES, MAX_ORDER, Have, HaveEntry, encode_control
from udp_mesh.core.logs.serving import Send

GATHER_S = 0.05
"""Changes within this time share one announcement."""
INTERVAL_S = 0.25
"""Minimum interval of announcements: a burst of small items costs few of them."""
COMPLETE_INTERVAL_S = 60.0
"""Interval of complete announcements: they repair what a lost one left."""
MAX_ORDERS = 4096
"""Peers whose announcements are counted: a key holder inventing names."""
_NEVER = float("inf")


class Announcements:
    """`entry(log, peer)` is what to announce of a log (None: nothing, because its topic is no longer a log)."""

    def __init__(self, send: Send, entry: Callable[[LogKey, str], HaveEntry | None], now: float) -> None:
        self._send = send
        self._entry = entry
        self._changed: dict[LogKey, bool] = {}
        """Changed logs; True if only what readers have was heard from others."""
        self._orders: dict[str, int] = {}
        """By peer, least recent first: the order of the last announcement, kept while it is offline."""
        self._announced_at = float("-inf")
        self._announce_at = _NEVER
        self._complete_at = now + COMPLETE_INTERVAL_S
        self._answer_at = _NEVER
        """When a peer that asked again soon gets its answer."""

    @property
    def next_at(self) -> float:
        return min(self._announce_at, self._complete_at, self._answer_at)

    def note(self, log: LogKey, now: float, *, heard: bool = False) -> None:
        """Something about this log changed; `heard`: only what its readers have, as reported by others. Peers with a
        reader in reach hear that from the reader itself."""
        self._changed[log] = heard and self._changed.get(log, True)
        self._announce_at = min(self._announce_at, max(now + GATHER_S, self._announced_at + INTERVAL_S))

    def run(self, logs: Iterable[LogKey], peers: Mapping[str, PeerView], now: float) -> None:
        """Send what is due."""
        if now >= self._complete_at:
            self._complete_at = now + COMPLETE_INTERVAL_S
            for view in peers.values():
                view.needs_all = True
        everything = tuple(logs)
        self._answer_at = _NEVER
        for peer, view in peers.items():
            if not view.needs_all:
                continue
            if now < view.announced_at + INTERVAL_S:
                # A peer can ask with few bytes for many.
                self._answer_at = min(self._answer_at, view.announced_at + INTERVAL_S)
                continue
            view.needs_all, view.announced_at = False, now
            if self._tell(peer, everything, complete=True, asks=not view.asked, now=now):
                view.asked = True
            else:
                view.needs_all = True
                self._answer_at = min(self._answer_at, now + INTERVAL_S)
        if now < self._announce_at:
            return
        self._announce_at, self._announced_at = _NEVER, now
        changed, self._changed = self._changed, {}
        for peer, view in peers.items():
            relevant = [log for log, heard in changed.items() if not (heard and log in view.reader_online)]
            if relevant and not self._tell(peer, relevant, complete=False, asks=False, now=now):
                view.needs_all = True

    def _tell(self, peer: str, logs: Sequence[LogKey], *, complete: bool, asks: bool, now: float) -> bool:
        """Returns whether the transport accepted all of it: its queue for the peer may be full."""
        entries = [entry for log in logs if (entry := self._entry(log, peer)) is not None]
        for start in range(0, max(len(entries), 1), MAX_ENTRIES):
            first = start == 0
            order = self._orders.pop(peer, 0) % MAX_ORDER + 1
            self._orders[peer] = order
            if len(self._orders) > MAX_ORDERS:
                del self._orders[next(iter(self._orders))]
            part = tuple(entries[start : start + MAX_ENTRIES])
            message = Have(part, complete and first, asks and first, order)
            if isinstance(self._send(CONTROL_TOPIC, encode_control(message), peer, now), Rejected):
                return False
        return True
