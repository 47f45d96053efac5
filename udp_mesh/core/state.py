"""The state shared by the parts of one node: settings, peers, queues, and who has something to send.

The parts, in the order that bytes and messages pass them: `receive` and `frame_handlers` (datagrams in),
`peer_lifecycle` (peers come and go), `publish` (messages in), `transmit` (datagrams out, timers), `endpoint`
(conditions out). Each consists of functions of this state and of `now`.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace
from heapq import heappop, heappush

from udp_mesh.core.broadcast import BroadcastQueue, NackRepair
from udp_mesh.core.compression import CompressionQueue
from udp_mesh.core.congestion.channel_share import ChannelShare
from udp_mesh.core.event_queue import EventQueue
from udp_mesh.core.interfaces import Background, Datagram, RandomSource, Store
from udp_mesh.core.meter import Meter
from udp_mesh.core.outbox import Outboxes
from udp_mesh.core.peers.heartbeat import HeartbeatScheduler
from udp_mesh.core.peers.key_mismatch import KeyMismatchLimiter
from udp_mesh.core.peers.peer_table import PeerTable
from udp_mesh.core.peers.session import Peer, Session
from udp_mesh.core.peers.unknown_boots import UnknownBoots
from udp_mesh.core.priority_backoff import PriorityBackoff
from udp_mesh.core.sender.message import TopicChannel
from udp_mesh.core.sender.rate_limit import TokenBucket
from udp_mesh.core.sender.sender import Sender
from udp_mesh.core.settings import RELAY_LINK, LinkInfo, LinkKind, Neighbour, Settings, Topic
from udp_mesh.core.subscriptions.selection import Selection
from udp_mesh.core.thin.copies import MessageCopies
from udp_mesh.core.versions.sent import SentVersions
from udp_mesh.crypto import Key, SendChannel

_NEVER = float("inf")

MAINTENANCE_INTERVAL_S = 0.5
"""Interval of maintenance rounds: offline checks, purges, starvation."""

SUSPENDED_S = 1.0
"""A round that is this late means that the process was suspended. A busy machine causes less."""


def live_keys(settings: Settings) -> tuple[Key, ...]:
    """The keys of the settings, or the public key of unkeyed mode."""
    return settings.keys or (Key.unkeyed(),)


class State:
    """See the module's docstring. Used only by the parts of a node."""

    def __init__(
        self,
        settings: Settings,
        boot_id: bytes,
        rng: RandomSource,
        now: float,
        store: Store | None,
        background: Background,
    ) -> None:
        self.settings = settings
        self.boot_id = boot_id
        self.rng = rng
        self.keys = live_keys(settings)
        self.links: dict[str, LinkInfo] = {}
        self.peer_table = PeerTable(settings, boot_id)
        self.unknown_boots = UnknownBoots(boot_id)
        self.sent = Meter(now)
        """Wire bytes sent by this node to all nodes."""
        self.channel_share = ChannelShare()
        self.event_queue = EventQueue(settings.limits.events)
        self.outboxes = Outboxes(store, self.peer_table.send_memory)
        self.heartbeats = HeartbeatScheduler(rng, settings.rates, now)
        self.broadcasts = BroadcastQueue()
        self.compression_queue = CompressionQueue()
        self.versions = SentVersions(settings.limits.version_bytes, self.peer_table.version_counters, background)
        """What peers have of topics that are sent as differences."""
        self.selection = Selection()
        """Which messages peers' programs want."""
        self.on_subscriptions: Callable[[Session, str, bytes, float], bool] = lambda *_: False
        """Takes messages about subscriptions, given session, topic, payload and now; False for any other message."""
        self.thin_counter = 0
        """Frames sent on thin links: each is sealed under a number of its own, also after the links were changed."""
        self.thin_copies = MessageCopies()
        """Messages of which thin links may bring another copy."""
        self.inflating: dict[Session, None] = {}
        """Sessions with a message being inflated."""
        self.broadcast_channel = SendChannel(self.keys[0], boot_id)
        self.late_acknowledgements = 0
        """Acknowledgments sent so far of which `AckState.is_late` was true."""
        self.priority_backoff = PriorityBackoff(settings.rates, now)
        self.repairs: dict[bytes, NackRepair] = {}
        """By the sender's boot id."""
        self.repairs_due: dict[bytes, None] = {}
        """Those of `repairs` with missing broadcasts."""
        self.maintain_from = 0
        """Index of the first idle peer of the next maintenance round."""
        self.topics: dict[str, Topic] = {topic.name: topic for topic in settings.topics}
        self.channels: dict[tuple[str, str], TopicChannel] = {}
        self.rate_limits: dict[str, TokenBucket] = {}
        self.next_message_id = 1
        self.ready: dict[Peer, None] = {}
        """Peers to which something may be ready to send."""
        self.control_ready: dict[Session, None] = {}
        """Sessions with an acknowledgment or control frames to send now."""
        self.outgoing: list[Datagram] = []
        """Datagrams already built: heartbeats, redundant copies."""
        self.relayed: list[tuple[int, Datagram]] = []
        """Datagrams for nodes behind relays, each with its priority."""
        self.relay_targets: dict[bytes, Neighbour] = {}
        """Boots that are better reached through relays than directly, by boot id."""
        self.timers: list[tuple[float, int, Peer]] = []
        self.timer_serial = 0
        self.maintenance_at = now
        self.maintained_at = now
        self.key_mismatches = KeyMismatchLimiter()
        self.incompatible_reported: dict[bytes, float] = {}
        self.own_name_reported_at = float("-inf")
        self.closed = False

    def topic(self, name: str) -> Topic | None:
        """The settings of a topic; those of undeclared ones, if it is none of its own (None: it is refused)."""
        return self.topics.get(name, self.settings.undeclared)

    def named_topic(self, name: str) -> Topic | None:
        """The same, under its name."""
        topic = self.topic(name)
        return topic if topic is None or topic.name == name else replace(topic, name=name)

    def set_timer(self, peer: Peer, at: float) -> None:
        """Set the peer's timer to `at`, unless it is due earlier."""
        if at < peer.due_at:
            peer.due_at = at
            self._queue(peer)

    def arm(self, peer: Peer) -> None:
        """Set the peer's timer to what its sender and receiver need now, even if that is later than before."""
        at = peer.sender.timer() if peer.sender is not None else None
        session = peer.session
        if session is not None:
            due = session.receiver.acks.due_at
            if due is not None and (at is None or due < at):
                at = due
        peer.due_at = _NEVER if at is None else at
        self._queue(peer)

    def _queue(self, peer: Peer) -> None:
        if peer.due_at < peer.timer_at:
            peer.timer_at = peer.due_at
            self.timer_serial += 1
            heappush(self.timers, (peer.timer_at, self.timer_serial, peer))

    def next_peer_at(self) -> float:
        """When the first peer's timer is due. Entries rescheduled to a later time are moved only when they reach the
        front, because they may be rescheduled a hundred times before."""
        timers = self.timers
        while timers:
            at, _, peer = timers[0]
            if peer.timer_at != at:
                heappop(timers)
            elif peer.due_at > at:
                peer.timer_at = _NEVER
                heappop(timers)
                self._queue(peer)
            else:
                return at
        return _NEVER

    def schedule_repair(self, boot_id: bytes, repairs: NackRepair) -> None:
        """Schedule the requests for what is missing from this sender."""
        if repairs.next_at != float("inf"):
            self.repairs_due[boot_id] = None
            self.maintenance_at = min(self.maintenance_at, repairs.next_at)

    def schedule_control(self, session: Session) -> None:
        """Mark the session as having an acknowledgment or control frames to send."""
        self.control_ready[session] = None

    def waiting_senders(self) -> Iterator[Sender]:
        """The senders of online peers with pending messages."""
        for peer in self.peer_table.peers.values():
            if peer.sender is not None and peer.online and peer.sender.pending:
                yield peer.sender

    def own_links(self) -> list[LinkInfo]:
        """The links that are network attachments of this node."""
        return [link for link in self.links.values() if link.name != RELAY_LINK]

    def is_better_path(self, session: Session, link: str) -> bool:
        """Whether the session's path should move to this link: from a relay to a direct link, or to a relay."""
        relayed = link == RELAY_LINK
        if (session.path.link == RELAY_LINK) == relayed:
            return False
        return (session.boot_id in self.relay_targets) == relayed

    def can_broadcast(self) -> bool:
        """Whether a link reaches all nodes with one datagram."""
        return any(link.kind is LinkKind.BROADCAST for link in self.links.values())
