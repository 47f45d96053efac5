"""Heartbeats: when the next one is sent and what it contains.

A heartbeat is sent every `heartbeat_s`; less often if traffic already proves every link, and less often the larger the
team, so that the cost of discovery per node stays constant. A newly heard node is answered soon with a heartbeat that
lists it: both then know that the link works both ways and that the other's heartbeats are not replayed.
"""

from collections.abc import Iterable
from dataclasses import replace

from udp_mesh.core import zstd
from udp_mesh.core.interfaces import Datagram, RandomSource
from udp_mesh.core.peers.session import Session
from udp_mesh.core.receiver.datagram_age import clock_echo, clock_ms
from udp_mesh.core.settings import LinkInfo, LinkKind, Neighbour, Rates, Settings
from udp_mesh.crypto import SendChannel
from udp_mesh.wire.codec import encode
from udp_mesh.wire.frames import Feature, Heartbeat, Waiting
from udp_mesh.wire.header import VERSION
from udp_mesh.wire.limits import MAX_HEARD, MAX_HEARD_CLOCKS

OWN_FEATURES = Feature.ZLIB | Feature.REPAIR | Feature.TIMED | Feature.COMPACT | Feature.THIN
ZSTD_FEATURES = Feature.ZSTD | Feature.VERSIONS if zstd.AVAILABLE else 0
"""With a Python that has zstd."""


def own_features(settings: Settings) -> int:
    """The features that this node announces."""
    features = OWN_FEATURES | ZSTD_FEATURES
    if settings.confirms:
        features |= Feature.CONFIRM
    if any(topic.log is not None for topic in settings.topics):
        features |= Feature.LOGS
    if settings.relay.hops > 1:
        features |= Feature.RELAY
    if settings.selective:
        features |= Feature.SUBSCRIPTIONS
    return features


REPLY_WITHIN_S = 0.1
"""A new node is answered within this time, after a random part of it, so that a team does not answer all at once."""

MIN_GAP_S = 0.2
"""Minimum time between two heartbeats."""

DISCOVERY_RATE_FACTOR = 5.0
"""Factor on the heartbeat rate while a team is discovered: 150 full heartbeats a second are 1 Mbit/s."""

MAX_PENDING_REPLIES = 2048
"""New nodes waiting to be listed: enough for a team of a thousand twice over. A key holder can invent more."""

JITTER = 0.1
"""Random fraction of the interval, so that two nodes never stay in step."""

MISSED_HEARTBEATS = 3.5
"""A peer is offline only after so many of its announced intervals without a heartbeat."""


def _hears_us(session: Session, rates: Rates, now: float) -> bool:
    """Whether the peer acknowledged something recently. One that came online recently may wait for a heartbeat that
    lists it."""
    peer = session.peer
    if peer is None or peer.online_since is None or now - peer.online_since <= rates.heartbeat_sparse_s:
        return False
    sender = peer.sender
    return sender is not None and sender.delivered_packets > 0 and now - sender.delivered_at < rates.heartbeat_s


class HeartbeatScheduler:
    """`next_at` is when the next heartbeat is due."""

    __slots__ = ("_heard_per_s", "_interval_s", "_last_at", "_next_listed", "_pending_replies", "_rng", "next_at")

    def __init__(self, rng: RandomSource, rates: Rates, now: float) -> None:
        self._rng = rng
        self._heard_per_s = rates.heartbeats_heard_per_s
        self._interval_s = 1.0
        self._last_at = float("-inf")
        self._pending_replies: dict[bytes, Session] = {}
        self._next_listed = 0
        self.next_at = now

    def reply_to(self, session: Session, team: int, now: float) -> None:
        """List a newly heard (or still unverified) session soon."""
        self._pending_replies[session.heard_tag] = session
        if len(self._pending_replies) > MAX_PENDING_REPLIES:
            del self._pending_replies[next(iter(self._pending_replies))]
        self.schedule_now(team, now)

    def schedule_now(self, team: int, now: float) -> None:
        """Schedule a heartbeat within `REPLY_WITHIN_S`, unless the last one is too recent; later in a team of `team`
        nodes."""
        share_s = team / (DISCOVERY_RATE_FACTOR * self._heard_per_s)
        soon = now + max(REPLY_WITHIN_S, share_s) * (0.2 + 0.8 * self._rng.random())
        self.next_at = min(self.next_at, max(self._last_at + max(MIN_GAP_S, share_s), soon))

    def interval_s(self, settings: Settings, sessions: list[Session], now: float) -> float:
        """Time until the next heartbeat: sparse if every peer acknowledged something recently, and longer in a large
        team."""
        rates = settings.rates
        online = [session for session in sessions if session.peer is not None and session.peer.online]
        verified = bool(online) and all(_hears_us(session, rates, now) for session in online)
        base = rates.heartbeat_sparse_s if verified else rates.heartbeat_s
        return max(base, len(online) / rates.heartbeats_heard_per_s)

    def build(
        self,
        settings: Settings,
        sessions: list[Session],
        waiting: tuple[Waiting, ...],
        next_broadcast: int,
        sent_bytes_per_s: float,
        now: float,
    ) -> Heartbeat:
        """Build the heartbeat to send now and schedule the next one. `encode_numbered` fills in `broadcast_number`."""
        self._heard_per_s = settings.rates.heartbeats_heard_per_s
        self._interval_s = self.interval_s(settings, sessions, now)
        self._last_at = now
        self.next_at = now + self._interval_s * (1 - JITTER * self._rng.random())
        heard, heard_clocks = self._heard(sessions, settings.name, now)
        if self._pending_replies:
            # More new nodes than one heartbeat can list: send another one soon instead of waiting for the regular one.
            self.schedule_now(len(sessions), now)
        return Heartbeat(
            settings.name,
            VERSION,
            VERSION,
            own_features(settings),
            min(65_535, int(self._interval_s * 1000)),
            min(65_535, sum(1 for session in sessions if session.peer is not None and session.peer.online)),
            min(0xFFFFFFFF, int(sent_bytes_per_s)),
            0,
            next_broadcast,
            heard,
            waiting,
            clock_ms(now),
            heard_clocks,
        )

    def _heard(self, sessions: list[Session], own_name: str, now: float) -> tuple[tuple[bytes, ...], tuple[int, ...]]:
        """Tags of the nodes to answer first, then of the others in turn; and the clocks of the first ones: who is
        answered may not believe us without (see `first_contact`), and would ask, as would every other node of a large
        team. For those to answer that have no room beside their clock there is another heartbeat."""
        tags = list(self._pending_replies)[:MAX_HEARD_CLOCKS]
        replied = [self._pending_replies.pop(tag) for tag in tags]
        # Those of earlier versions, which send no clock, follow.
        replied.sort(key=lambda session: session.clock_ms is None)
        tags = [session.heard_tag for session in replied]
        clocks = [clock_echo(session.clock_ms) for session in replied if session.clock_ms is not None]
        # A boot whose name was taken by another is not listed: its messages are not accepted, and it must learn that.
        listed = [
            candidate
            for candidate in sessions
            if candidate.is_current or not candidate.verified or candidate.name == own_name
        ]
        recent = [session for session in listed if now - session.last_heard < MISSED_HEARTBEATS * session.interval_s]
        if recent:
            start = self._next_listed % len(recent)
            for session in recent[start:] + recent[:start]:
                if len(tags) >= MAX_HEARD:
                    break
                if session.heard_tag not in tags and session.heard_tag not in self._pending_replies:
                    tags.append(session.heard_tag)
                self._next_listed += 1
        return tuple(tags), tuple(clocks)


def encode_numbered(beat: Heartbeat, channel: SendChannel) -> bytes:
    """Encode the heartbeat with the number of the packet that will carry it."""
    return encode([replace(beat, broadcast_number=channel.next_number)])


def heartbeat_datagrams(
    beat: Heartbeat, channel: SendChannel, links: Iterable[LinkInfo], neighbours: tuple[Neighbour, ...]
) -> list[Datagram]:
    """The heartbeat for every link: one datagram to the broadcast address, or one per configured neighbor."""
    out: list[Datagram] = []
    links = list(links)
    for link in links:
        targets = [neighbour for neighbour in neighbours if not neighbour.legacy and uses_link(neighbour, link, links)]
        if link.kind is LinkKind.NEIGHBOURS and not targets:
            continue
        _, data = channel.seal_long(encode_numbered(beat, channel))
        if link.kind is LinkKind.BROADCAST:
            out.append(Datagram(link.name, link.broadcast, data, True))
        out.extend(Datagram(link.name, neighbour.address, data, True) for neighbour in targets)
    return out


def uses_link(neighbour: Neighbour, link: LinkInfo, links: list[LinkInfo]) -> bool:
    """Whether the neighbor is reached over this link."""
    if neighbour.link is not None:
        return neighbour.link == link.name
    if any(other.kind is LinkKind.NEIGHBOURS for other in links):
        return link.kind is LinkKind.NEIGHBOURS
    return link is links[0]
