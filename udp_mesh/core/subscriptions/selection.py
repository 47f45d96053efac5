"""Choose the messages to send to a peer: topics that its programs read, no faster and no older than they want.

A message is admitted, dropped, or withheld to be admitted or dropped later (`take_due`):

- One of a topic that no program there reads is dropped. A reliable one is withheld for `GRACE_S` first: a program that
  has subscribed before the message was sent gets it, though its peer's table is still under way.
- Of a topic with a maximum rate, the newest message of each interval is sent.
- A maximum age shortens the message's life, so that it ends where it waits.

Always sent: urgent messages, topics with `always` or an outbox, logs, and everything to peers that do not say what
they read.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from heapq import heapify, heappop, heappush
from typing import NamedTuple

from udp_mesh.core.events import ExpiryReason
from udp_mesh.core.peers.session import Peer, Session
from udp_mesh.core.sender.message import AcceptedMessage
from udp_mesh.core.settings import Outbox, Settings, Topic
from udp_mesh.core.subscriptions.conditions import SavedCounters
from udp_mesh.core.subscriptions.messages import UNBOUNDED, Bounds
from udp_mesh.wire.frames import Feature, MessageFlag

GRACE_S = 1.0
"""Longer than a table takes over a poor link, short for a program that waits for an outcome."""
MAX_WITHHELD_MESSAGES = 256
MAX_WITHHELD_BYTES = 8 << 20
"""Unread messages withheld, for all peers together: a program that sends much that no program reads. The oldest is then
dropped early."""
MAX_PACED = 4096
"""Pairs of a peer and a topic with a maximum rate: a program inventing topics. A further one is not slowed down."""
ASK_INTERVAL_S = 10.0
"""Between two questions to a peer that did not answer yet; the question itself is retransmitted."""
MAX_ASKED = 1024
"""Boots of which it is remembered when they were asked, before those that have been replaced are forgotten."""
_NEVER, _ALWAYS = float("inf"), float("-inf")

Destination = str | None
"""A peer's name, or None: all peers, with a broadcast."""


class Withheld(NamedTuple):
    """A message to admit again."""

    destination: Destination
    accepted: AcceptedMessage


@dataclass(slots=True)
class _Pace:
    """When the next message of a topic may leave, and the newest one that waits for that."""

    next_at: float
    waiting: AcceptedMessage | None = None
    scheduled_at: float = _NEVER
    """Time of its valid entry among those scheduled."""


class Selection:
    """`on_drop` is called for each message that is given up, `take_due` at `next_at`. `to_ask` collects the sessions
    whose table is not known."""

    def __init__(self) -> None:
        self.on_drop: Callable[[Destination, AcceptedMessage, ExpiryReason], None] = lambda *_: None
        self._enabled = False
        self._urgent_priority = 0
        self._unread: deque[Withheld] = deque()
        self._unread_bytes = 0
        self._paces: dict[tuple[Destination, str], _Pace] = {}
        self._due: list[tuple[float, int, Destination, _Pace]] = []
        """A heap, by time, of those that have, or had, a waiting message."""
        self._serial = 0
        self._paced_bytes = 0
        self._saved: dict[Destination, SavedCounters] = {}
        self._asked_at: dict[Session, float] = {}
        self.to_ask: dict[Session, None] = {}
        self.next_at = _NEVER

    def apply(self, settings: Settings) -> None:
        """Take over changed settings; what is withheld is admitted when it is due."""
        self._enabled = settings.selective
        self._urgent_priority = settings.rates.urgent_priority

    @property
    def withheld_bytes(self) -> int:
        """Bytes of all messages that are withheld."""
        return self._unread_bytes + self._paced_bytes

    def saved(self, destination: Destination) -> SavedCounters:
        """Messages that this peer was not sent."""
        return self._saved.get(destination) or SavedCounters()

    # Admitting

    def admit(self, peer: Peer, accepted: AcceptedMessage, now: float) -> AcceptedMessage | None:
        """The message as it may be sent to this peer; None if it is withheld or dropped."""
        if not self._enabled or self._is_exempt(accepted.channel.topic):
            return accepted
        return self._decide(peer.name, self._wanted(peer, accepted.channel.name, now), accepted, now)

    def admit_to_all(self, peers: Iterable[Peer], accepted: AcceptedMessage, now: float) -> AcceptedMessage | None:
        """The message as it may be broadcast to these peers: what satisfies those that want most."""
        if not self._enabled or self._is_exempt(accepted.channel.topic):
            return accepted
        return self._decide(None, self._wanted_by_any(peers, accepted.channel.name, now), accepted, now)

    def _wanted_by_any(self, peers: Iterable[Peer], topic: str, now: float) -> Bounds | None:
        """Bounds that satisfy all peers. Asks one of those whose table is not known, and none if another wants
        everything: to ask a whole team would cost more than many broadcasts."""
        unknown: list[tuple[Peer, Session]] = []
        bounds: Bounds | None = None
        known = False
        for peer in peers:
            if peer.legacy:
                # It gets a copy of its own.
                continue
            known = True
            session = peer.session
            if session is not None and session.features & Feature.SUBSCRIPTIONS and not _is_known(peer, session):
                unknown.append((peer, session))
                continue
            answer = self._wanted(peer, topic, now)
            if answer is not None:
                bounds = answer if bounds is None else bounds.united(answer)
                if bounds == UNBOUNDED:
                    return bounds
        for peer, session in unknown:
            if self._ask(peer, session, now):
                break
        return UNBOUNDED if unknown or not known else bounds

    def is_unread(self, peer: Peer, topic: Topic, now: float) -> bool:
        """Whether no program there reads this topic, and it is not sent for other reasons."""
        return self._enabled and not self._is_exempt(topic) and self._wanted(peer, topic.name, now) is None

    def _is_exempt(self, topic: Topic) -> bool:
        return (
            topic.always
            or topic.priority <= self._urgent_priority
            or topic.outbox is not Outbox.NONE
            or topic.log is not None
        )

    def _wanted(self, peer: Peer, topic: str, now: float) -> Bounds | None:
        session = peer.session
        if session is None or not peer.online or not session.features & Feature.SUBSCRIPTIONS:
            return UNBOUNDED
        if session.subscriptions is None or not _is_known(peer, session):
            self._ask(peer, session, now)
            return UNBOUNDED
        return session.subscriptions.bounds(topic)

    def _ask(self, peer: Peer, session: Session, now: float) -> bool:
        """Ask for the peer's table, unless it was asked a short time ago. Whether it is asked now."""
        asked_at = self._asked_at.get(session, _ALWAYS)
        if now < asked_at + ASK_INTERVAL_S and asked_at >= (peer.online_since or asked_at):
            return False
        if len(self._asked_at) >= MAX_ASKED:
            self._asked_at = {known: at for known, at in self._asked_at.items() if known.is_current}
        self._asked_at[session] = now
        self.to_ask[session] = None
        self.next_at = min(self.next_at, now)
        return True

    def _decide(
        self, destination: Destination, bounds: Bounds | None, accepted: AcceptedMessage, now: float
    ) -> AcceptedMessage | None:
        if bounds is None:
            if accepted.flags & MessageFlag.RELIABLE and now < accepted.accepted_at + GRACE_S:
                self._withhold(Withheld(destination, accepted))
            else:
                self._drop(destination, accepted, ExpiryReason.NOT_WANTED)
            return None
        if bounds.max_age_s is not None:
            deadline = accepted.accepted_at + bounds.max_age_s
            if accepted.deadline is None or deadline < accepted.deadline:
                accepted = accepted._replace(deadline=deadline)
        if accepted.deadline is not None and accepted.deadline <= now:
            self._drop(destination, accepted, ExpiryReason.DEADLINE)
            return None
        if bounds.rate_hz is not None and not self._is_next(destination, bounds.rate_hz, accepted, now):
            return None
        return accepted

    def _is_next(self, destination: Destination, rate_hz: float, accepted: AcceptedMessage, now: float) -> bool:
        """Whether this message may leave now; otherwise it waits in place of an older one."""
        key = (destination, accepted.channel.name)
        pace = self._paces.get(key)
        if pace is None:
            if len(self._paces) >= MAX_PACED:
                self._paces = {
                    each: pace for each, pace in self._paces.items() if pace.waiting is not None or pace.next_at > now
                }
            if len(self._paces) < MAX_PACED:
                self._paces[key] = _Pace(now + 1 / rate_hz)
            return True
        older = self._replace_waiting(pace, None)
        if older is not None:
            self._drop(destination, older, ExpiryReason.SUPERSEDED)
        pace.next_at = min(pace.next_at, now + 1 / rate_hz)
        if now >= pace.next_at:
            pace.next_at = now + 1 / rate_hz
            return True
        self._replace_waiting(pace, accepted)
        if older is None:
            self._schedule(destination, pace)
        self.next_at = min(self.next_at, pace.next_at)
        return False

    def _replace_waiting(self, pace: _Pace, accepted: AcceptedMessage | None) -> AcceptedMessage | None:
        """Let this message wait. Returns the one that waited until now."""
        before, pace.waiting = pace.waiting, accepted
        self._paced_bytes += _size(accepted) - _size(before)
        return before

    def _schedule(self, destination: Destination, pace: _Pace) -> None:
        if pace.scheduled_at <= pace.next_at:
            return
        pace.scheduled_at = pace.next_at
        self._serial += 1
        heappush(self._due, (pace.next_at, self._serial, destination, pace))
        if len(self._due) > 64 + 2 * len(self._paces):
            # Free entries that were replaced by earlier ones.
            self._due = [entry for entry in self._due if entry[3].scheduled_at == entry[0]]
            heapify(self._due)

    def _withhold(self, withheld: Withheld) -> None:
        self._unread.append(withheld)
        self._unread_bytes += len(withheld.accepted.payload)
        while len(self._unread) > MAX_WITHHELD_MESSAGES or self._unread_bytes > MAX_WITHHELD_BYTES:
            oldest = self._unread.popleft()
            self._unread_bytes -= len(oldest.accepted.payload)
            self._drop(oldest.destination, oldest.accepted, ExpiryReason.NOT_WANTED)
        if self._unread:
            self.next_at = min(self.next_at, self._unread[0].accepted.accepted_at + GRACE_S)

    # Later

    def take_due(self, now: float) -> list[Withheld]:
        """The messages to admit again now."""
        due: list[Withheld] = []
        while self._unread and self._unread[0].accepted.accepted_at + GRACE_S <= now:
            due.append(self._unread.popleft())
            self._unread_bytes -= len(due[-1].accepted.payload)
        self.next_at = self._unread[0].accepted.accepted_at + GRACE_S if self._unread else _NEVER
        while self._due and self._due[0][0] <= now:
            at, _, destination, pace = heappop(self._due)
            if at != pace.scheduled_at:
                continue
            pace.scheduled_at = _NEVER
            if pace.waiting is None:
                continue
            if pace.next_at > now:
                self._schedule(destination, pace)
            else:
                due.append(Withheld(destination, pace.waiting))
                self._replace_waiting(pace, None)
        if self._due:
            self.next_at = min(self.next_at, self._due[0][0])
        return due

    def take_for(self, name: str) -> list[Withheld]:
        """All that is withheld from this peer, or from all, in the order accepted: its table changed."""
        concerned = (name, None)
        found = [withheld for withheld in self._unread if withheld.destination in concerned]
        self._unread = deque(withheld for withheld in self._unread if withheld.destination not in concerned)
        self._unread_bytes = sum(len(withheld.accepted.payload) for withheld in self._unread)
        for (destination, _), pace in self._paces.items():
            if destination in concerned and pace.waiting is not None:
                found.append(Withheld(destination, pace.waiting))
                self._replace_waiting(pace, None)
        found.sort(key=lambda withheld: withheld.accepted.message_id)
        return found

    def close(self) -> None:
        """End everything that is withheld."""
        waiting = [Withheld(key[0], pace.waiting) for key, pace in self._paces.items() if pace.waiting is not None]
        for withheld in (*self._unread, *waiting):
            self.on_drop(withheld.destination, withheld.accepted, ExpiryReason.CLOSED)
        self._unread.clear()
        self._paces.clear()
        self._unread_bytes = self._paced_bytes = 0
        self._due.clear()
        self.next_at = _NEVER

    # Counting

    def _drop(self, destination: Destination, accepted: AcceptedMessage, reason: ExpiryReason) -> None:
        self.count(destination, accepted, reason)
        self.on_drop(destination, accepted, reason)

    def count(self, destination: Destination, accepted: AcceptedMessage, reason: ExpiryReason) -> None:
        """Count a message that is not sent for one of our reasons."""
        saved = self._saved.setdefault(destination, SavedCounters())
        size = len(accepted.body)
        match reason:
            case ExpiryReason.NOT_WANTED:
                saved.unread_messages += 1
                saved.unread_bytes += size
            case ExpiryReason.SUPERSEDED:
                saved.thinned_messages += 1
                saved.thinned_bytes += size
            case _ if _is_aged(accepted):
                saved.aged_messages += 1
                saved.aged_bytes += size
            case _:
                pass

    def on_deadline(self, destination: str, accepted: AcceptedMessage) -> None:
        """A message expired where it waited for its turn: perhaps because of a reader's maximum age."""
        if self._enabled and _is_aged(accepted):
            self.count(destination, accepted, ExpiryReason.DEADLINE)


def _size(accepted: AcceptedMessage | None) -> int:
    """Bytes in memory."""
    if accepted is None:
        return 0
    return len(accepted.payload) + (0 if accepted.body is accepted.payload else len(accepted.body))


def _is_known(peer: Peer, session: Session) -> bool:
    """Whether the peer's table came since it was last offline: before, it may have failed to announce a change."""
    table = session.subscriptions
    return table is not None and (peer.online_since is None or table.confirmed_at >= peer.online_since)


def _is_aged(accepted: AcceptedMessage) -> bool:
    """Whether a reader's maximum age shortened its life."""
    life_s = accepted.channel.topic.deadline_s
    if accepted.deadline is None:
        return False
    return life_s is None or accepted.deadline < accepted.accepted_at + life_s
