"""Announces to peers which items this node holds: everything at a meeting and once a minute, changes as follows.

Changes that a peer can act on at once are announced soon: a source's new items to all, any new items to readers, and to
a source what its readers have. Everything else (what this node carries now, what a reader has) only saves others work:
it travels with the next announcement, or within `CARRIED_S`. A peer gets the next announcement once it has acknowledged
the one before, so that little is repeated to one that is out of reach."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from udp_mesh.core.events import MessageId, Rejected
from udp_mesh.core.logs.item import LogKey
from udp_mesh.core.logs.knowledge import PeerView
from udp_mesh.core.logs.messages import CONTROL_TOPIC, MAX_ENTRIES, MAX_ORDER, Have, HaveEntry, encode_control
from udp_mesh.core.logs.serving import Send

GATHER_S = 0.05
"""Changes within this time share one announcement."""
INTERVAL_S = 0.25
"""Minimum interval of announcements to a peer: a burst of small items costs few of them."""
CARRIED_S = 2.0
"""Delay of what only saves others work; less than carriers leave items to others."""
COMPLETE_INTERVAL_S = 60.0
"""Interval of complete announcements: they repair what a lost one left."""
MAX_ORDERS = 4096
"""Peers whose announcements are counted: a key holder inventing names."""
_NEVER = float("inf")


@dataclass(slots=True)
class _Pending:
    """Changes not yet announced to one peer."""

    logs: dict[LogKey, None] = field(default_factory=dict)
    due_at: float = _NEVER
    sent_at: float = float("-inf")
    sending: MessageId | None = None
    """The last announcement, until it has an outcome."""


class Announcements:
    """`entry(log, peer)` is what to announce of a log (None: nothing, because its topic is no longer a log);
    `is_urgent(log, peer)` whether the peer can act on it at once."""

    def __init__(
        self,
        send: Send,
        entry: Callable[[LogKey, str], HaveEntry | None],
        is_urgent: Callable[[LogKey, str], bool],
        now: float,
    ) -> None:
        self._send = send
        self._entry = entry
        self._is_urgent = is_urgent
        self._changed: dict[LogKey, bool] = {}
        """Changed logs; True if only what readers have was heard from others."""
        self._changed_at = _NEVER
        """When the first of them changed."""
        self._pending: dict[str, _Pending] = {}
        """By online peer."""
        self._orders: dict[str, int] = {}
        """By peer, least recent first: the order of the last announcement, kept while it is offline."""
        self._complete_at = now + COMPLETE_INTERVAL_S
        self._next_at = self._complete_at

    @property
    def next_at(self) -> float:
        return min(self._next_at, self._changed_at)

    def note(self, log: LogKey, now: float, *, heard: bool = False) -> None:
        """Something about this log changed; `heard`: only what its readers have, as reported by others. Peers with a
        reader in reach hear that from the reader itself."""
        self._changed[log] = heard and self._changed.get(log, True)
        self._changed_at = min(self._changed_at, now)

    def ended(self, message: MessageId) -> bool:
        """A message ended, whatever its outcome. Whether it was one of these."""
        for pending in self._pending.values():
            if pending.sending == message:
                pending.sending = None
                return True
        return False

    def run(self, logs: Iterable[LogKey], peers: Mapping[str, PeerView], now: float) -> None:
        """Send what is due."""
        if now >= self._complete_at:
            self._complete_at = now + COMPLETE_INTERVAL_S
            for view in peers.values():
                view.needs_all = True
        for gone in self._pending.keys() - peers.keys():
            del self._pending[gone]
        if self._changed:
            self._spread(peers, now)
        everything: tuple[LogKey, ...] | None = None
        self._next_at = self._complete_at
        for peer, view in peers.items():
            pending = self._pending.setdefault(peer, _Pending())
            if view.needs_all:
                # A peer can ask with few bytes for many.
                at = max(view.announced_at, pending.sent_at) + INTERVAL_S
                if now < at:
                    self._next_at = min(self._next_at, at)
                    continue
                everything = tuple(logs) if everything is None else everything
                view.announced_at = now
                done = self._tell(peer, pending, everything, complete=True, asks=not view.asked, now=now)
                view.needs_all, view.asked = not done, view.asked or done
            elif pending.sending is None and now >= pending.due_at:
                view.needs_all = not self._tell(peer, pending, tuple(pending.logs), complete=False, asks=False, now=now)
            if view.needs_all:
                self._next_at = min(self._next_at, now + INTERVAL_S)
            elif pending.sending is None:
                self._next_at = min(self._next_at, pending.due_at)

    def _spread(self, peers: Mapping[str, PeerView], now: float) -> None:
        """Note the changes for each peer."""
        changed, self._changed, self._changed_at = self._changed, {}, _NEVER
        for peer, view in peers.items():
            pending = self._pending.setdefault(peer, _Pending())
            for log, heard in changed.items():
                if heard and log in view.reader_online:
                    continue
                pending.logs[log] = None
                delay_s = GATHER_S if self._is_urgent(log, peer) else CARRIED_S
                pending.due_at = min(pending.due_at, max(now + delay_s, pending.sent_at + INTERVAL_S))

    def _tell(
        self, peer: str, pending: _Pending, logs: Sequence[LogKey], *, complete: bool, asks: bool, now: float
    ) -> bool:
        """Returns whether the transport accepted all of it: its queue for the peer may be full."""
        pending.logs, pending.due_at, pending.sent_at = {}, _NEVER, now
        entries = [entry for log in logs if (entry := self._entry(log, peer)) is not None]
        for start in range(0, max(len(entries), 1), MAX_ENTRIES):
            first = start == 0
            order = self._orders.pop(peer, 0) % MAX_ORDER + 1
            self._orders[peer] = order
            if len(self._orders) > MAX_ORDERS:
                del self._orders[next(iter(self._orders))]
            part = tuple(entries[start : start + MAX_ENTRIES])
            message = Have(part, complete and first, asks and first, order)
            sent = self._send(CONTROL_TOPIC, encode_control(message), peer, now)
            if isinstance(sent, Rejected):
                return False
            pending.sending = sent
        return True
