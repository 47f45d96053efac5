"""One boot of one peer, identified by its boot id: channels, path and pending control frames.

heard (a heartbeat, perhaps replayed) -> *verified* (it proved that it hears our current boot) -> replaced by the peer's
next boot, or dropped. Before verification only its heartbeat is believed.
"""

from typing import NamedTuple

from udp_mesh.core.link_trend import LinkTrend
from udp_mesh.core.meter import Meter
from udp_mesh.core.peers.peer_state import TRANSITIONS, PeerEvent, PeerState
from udp_mesh.core.peers.session_state import (
    RECEPTION_TRANSITIONS,
    SESSION_TRANSITIONS,
    Reception,
    ReceptionEvent,
    SessionEvent,
    SessionState,
)
from udp_mesh.core.receiver.datagram_age import ACCEPT_AGE_S, Freshness
from udp_mesh.core.receiver.memory_limit import MemoryBudget
from udp_mesh.core.receiver.receiver import Receiver
from udp_mesh.core.sender.path import Path
from udp_mesh.core.sender.send_memory import SendMemory
from udp_mesh.core.sender.sender import Sender
from udp_mesh.core.settings import Address, Settings
from udp_mesh.core.subscriptions.table import KnownTable
from udp_mesh.crypto import TO_ALL, Key, ReceiveChannel, SendChannel, age_together
from udp_mesh.wire.frames import Ack, Feature, Frame, Heartbeat, Waiting
from udp_mesh.wire.limits import HEARD_TAG_BYTES, MAX_HEARD


class HeldDatagram(NamedTuple):
    """An opened datagram from a boot whose first contact is not proven yet (see `first_contact`)."""

    number: int
    frames: bytes
    link: str
    source: Address
    introduced: bool
    """It came with a long header."""


class Challenge(NamedTuple):
    """A ping that validates a path when its pong comes from the same address."""

    link: str
    address: Address
    sent_at: float
    in_use: bool
    """It was sent to the current address."""


CHALLENGE_TIMEOUT_S = 60.0
"""How long a pong is awaited: a path may be that slow."""

STALE_PATH_S = 2.0
"""A path not heard for this long (two heartbeats) is replaced by one that is."""

MAX_REMEMBERED_FLOORS = 64
"""Removed keys whose counters a session remembers: years of rotations."""

MAX_PENDING_CONTROL = 64
"""Small frames (pongs, repair requests, refusals) waiting for one peer; more of them indicates a flood."""


# Compared for every peer of a large team: a global costs less than an enum member.
_ONLINE = PeerState.ONLINE
_VERIFIED = SessionState.VERIFIED
_UNKNOWN = Reception.UNKNOWN


class Meters:
    """Byte rates of one session."""

    __slots__ = ("delivered", "received", "sent")

    def __init__(self, now: float) -> None:
        self.sent = Meter(now)
        self.delivered = Meter(now)
        self.received = Meter(now)


class Peer:
    """A name: what is being sent to it, whichever of its boots receives.

    `sender` is None until `open_sender`: in a large team most nodes send to few. `memory` counts what waits for all
    peers.
    """

    __slots__ = (
        "_memory",
        "_settings",
        "conflict_reported_at",
        "due_at",
        "held_until",
        "legacy",
        "legacy_meters",
        "legacy_path",
        "name",
        "online_since",
        "retired",
        "sender",
        "session",
        "settling",
        "state",
        "timer_at",
        "trend",
    )

    def __init__(self, name: str, settings: Settings, memory: SendMemory | None = None) -> None:
        self.name = name
        self._settings = settings
        self._memory = memory
        self.sender: Sender | None = None
        self.trend: LinkTrend | None = None
        """Of what is sent: set with `sender`."""
        self.session: Session | None = None
        self.state = PeerState.LOST
        self.legacy = False
        self.legacy_path: tuple[Address, str, float] | None = None
        """Address and link from which a legacy program was last heard, and when."""
        self.legacy_meters: Meters | None = None
        """Set while it speaks the legacy format; then there is no session with meters."""
        self.settling = False
        """A legacy program that has just started: outboxes do not send to it yet."""
        self.online_since: float | None = None
        self.conflict_reported_at = float("-inf")
        self.retired: dict[bytes, None] = {}
        """Earlier boot ids, which are no longer accepted."""
        self.timer_at = float("inf")
        """Position in the node's timer queue: `due_at`, or earlier until the entry reaches the front."""
        self.due_at = float("inf")
        """When this peer's timer is due."""
        self.held_until: dict[int, float] = {}
        """Priority -> until when its hold-back for other robots is already counted."""

    def open_sender(self) -> Sender:
        """The sender, created if there is none yet."""
        if self.sender is None:
            self.sender = Sender(self._settings, self._memory, self.name)
            self.trend = LinkTrend()
        return self.sender

    @property
    def online(self) -> bool:
        return self.state is _ONLINE

    def transition(self, event: PeerEvent) -> None:
        self.state = TRANSITIONS[self.state, event]

    def record_held(self, levels: int, now: float, until: float) -> None:
        """Count how long the waiting levels of the mask are held back for other robots' urgent messages."""
        for priority, level in enumerate(self.open_sender().levels):
            if levels >> priority & 1:
                level.held_s += max(0.0, until - max(now, self.held_until.get(priority, now)))
                self.held_until[priority] = until

    def apply(self, settings: Settings) -> None:
        """Apply new settings; nothing in flight is touched."""
        self._settings = settings
        if self.sender is not None:
            self.sender.apply(settings)


class Session:
    """A boot id heard under a name."""

    __slots__ = (
        "_forgotten_floor",
        "_key_floors",
        "boot_id",
        "broadcast_channels",
        "challenged_at",
        "challenges",
        "clock_ms",
        "copy_opened_at",
        "data_channels",
        "features",
        "freshness",
        "held",
        "interval_s",
        "introduced_at",
        "last_heard",
        "met_at",
        "meters",
        "name",
        "name_conflict",
        "next_wire_id",
        "one_way_since",
        "path",
        "peer",
        "peer_receives",
        "peer_sends",
        "pending_control",
        "received_bytes",
        "receiver",
        "reception",
        "state",
        "subscriptions",
        "versions",
    )

    def __init__(
        self,
        name: str,
        boot_id: bytes,
        own_boot: bytes,
        keys: tuple[Key, ...],
        settings: Settings,
        memory: MemoryBudget | None = None,
    ) -> None:
        """`memory` is the budget of all peers (None: only this session's own limits apply)."""
        self.name = name
        self.boot_id = boot_id
        self.peer: Peer | None = None
        self.state = SessionState.NEW
        self.reception = Reception.UNKNOWN
        self.met_at: float | None = None
        """When its first heartbeat was heard."""
        self.one_way_since: float | None = None
        """Since when `reception` is ONE_WAY; None in other states."""
        self.name_conflict = False
        """Still heard after another boot took its name: two nodes share the name."""
        self.next_wire_id = 0
        """Next wire id of messages to it, saved when another boot took its name."""
        self.introduced_at = float("-inf")
        self.last_heard = float("-inf")
        self.meters = Meters(0.0)
        self.received_bytes = 0
        self.peer_sends = (0, float("-inf"))
        """Bytes per second that the peer reports sending to all nodes, and when it did."""
        self.peer_receives = (0, float("-inf"))
        """Bytes per second from us that the peer reports receiving, and when it did."""
        self.interval_s = settings.rates.heartbeat_s
        self.versions = (1, 1)
        self.features = 0
        self.subscriptions: KnownTable | None = None
        """What its programs read; None until it announced that."""
        self.receiver = Receiver(settings.rates, settings.limits, memory or MemoryBudget(1 << 62))
        self.path = Path(SendChannel(keys[0], own_boot, boot_id))
        self.pending_control: list[Frame] = []
        self.freshness = Freshness()
        self.clock_ms: int | None = None
        """Clock of its newest heartbeat, which ours echo; None if its version does not send it."""
        self.held: list[HeldDatagram] = []
        """Datagrams that take effect once its first contact is proven."""
        self.challenges: dict[int, Challenge] = {}
        """Path challenges without an answer yet, by token (see `path_validation`)."""
        self.challenged_at = float("-inf")
        self.copy_opened_at = float("-inf")
        """When a copy of a datagram that had come before was last opened."""
        self._key_floors: dict[tuple[bytes, bytes], int] = {}
        """(key id, receiver) of removed keys -> the number from which on datagrams are new."""
        self._forgotten_floor = 0
        self.data_channels: list[ReceiveChannel] = []
        self.broadcast_channels: list[ReceiveChannel] = []
        self.set_keys(own_boot, keys)

    @property
    def heard_tag(self) -> bytes:
        return self.boot_id[:HEARD_TAG_BYTES]

    def set_keys(self, own_boot: bytes, keys: tuple[Key, ...]) -> None:
        """Set the live keys. Channels of kept keys keep their replay windows; packet numbers continue across keys."""
        self.data_channels = self._receive_channels(self.data_channels, own_boot, keys)
        self.broadcast_channels = self._receive_channels(self.broadcast_channels, TO_ALL, keys)
        channel = self.path.channel
        if channel.key != keys[0]:
            self.path.channel = SendChannel(keys[0], own_boot, self.boot_id)
            self.path.channel.next_number = channel.next_number

    def _receive_channels(
        self, before: list[ReceiveChannel], receiver: bytes, keys: tuple[Key, ...]
    ) -> list[ReceiveChannel]:
        """A key that returns continues its numbers: what was sealed with it before is a replay. What is too old under
        one key is too old under a new one as well."""
        known = {channel.key: channel for channel in before}
        floors = self._key_floors
        for channel in before:
            if channel.key not in keys:
                floors[channel.key.key_id, channel.receiver_boot] = channel.window.next_new
        while len(floors) > MAX_REMEMBERED_FLOORS:
            self._forgotten_floor = max(self._forgotten_floor, floors.pop(next(iter(floors))))
        too_old = max((channel.window.floor for channel in before), default=0)
        channels = []
        for key in keys:
            kept = known.get(key)
            if kept is None:
                kept = ReceiveChannel(key, self.boot_id, receiver)
                kept.window.raise_floor(max(too_old, floors.get((key.key_id, receiver), self._forgotten_floor)))
            channels.append(kept)
        return channels

    def floors(self) -> dict[tuple[bytes, bytes], int]:
        """(key id, receiver) -> the number from which on datagrams are new, for every key ever used."""
        found = dict(self._key_floors)
        for channels in (self.data_channels, self.broadcast_channels):
            for channel in channels:
                found[channel.key.key_id, channel.receiver_boot] = channel.window.next_new
        return found

    def restore_floors(self, floors: dict[tuple[bytes, bytes], int]) -> None:
        """Restore the `floors` of this boot's earlier session."""
        self._key_floors = dict(floors)
        for channels in (self.data_channels, self.broadcast_channels):
            for channel in channels:
                channel.window.raise_floor(floors.get((channel.key.key_id, channel.receiver_boot), 0))

    def is_fresh(self, now: float) -> bool:
        """Whether something that cannot be a replay came recently."""
        return now - self.freshness.fresh_at <= ACCEPT_AGE_S

    def age_windows(self, now: float) -> None:
        """Advance the replay windows and drop unanswered challenges."""
        for token, challenge in list(self.challenges.items()):
            if now - challenge.sent_at > CHALLENGE_TIMEOUT_S:
                del self.challenges[token]
        age_together(self.data_channels, now)
        age_together(self.broadcast_channels, now)

    @property
    def is_current(self) -> bool:
        """Whether it is the current session of its name."""
        return self.peer is not None and self.peer.session is self

    @property
    def verified(self) -> bool:
        """It proved that it hears our current boot."""
        return self.state is _VERIFIED

    @property
    def knows_us(self) -> bool:
        """Introductions to it need no name any more."""
        return self.reception is not _UNKNOWN

    @property
    def timed(self) -> bool:
        """It timestamps what it sends."""
        return self.path.timed

    def transition(self, event: SessionEvent) -> None:
        self.state = SESSION_TRANSITIONS[self.state, event]

    def on_reception(self, event: ReceptionEvent, now: float) -> None:
        """The peer showed whether it hears us."""
        self.reception = RECEPTION_TRANSITIONS[self.reception, event]
        if self.reception is not Reception.ONE_WAY:
            self.one_way_since = None
        elif self.one_way_since is None:
            self.one_way_since = now

    def on_heard_list(self, heard: tuple[bytes, ...], own_tag: bytes, now: float) -> None:
        """Process the list of a broadcast heartbeat. A full list may have had no room for us."""
        if own_tag in heard:
            self.on_reception(ReceptionEvent.LISTED, now)
        elif len(heard) < MAX_HEARD:
            self.on_reception(ReceptionEvent.NOT_LISTED, now)

    def queue_control(self, frame: Frame) -> None:
        """Queue a small frame for the next datagrams."""
        if len(self.pending_control) < MAX_PENDING_CONTROL:
            self.pending_control.append(frame)

    def build_acks(self, now: float, waiting: tuple[Waiting, ...]) -> list[Ack]:
        """The acknowledgements to send now, mostly one. They then count as sent."""
        acks = self.receiver.acks
        if acks.largest < 0:
            return []
        arriving = min(0xFFFFFFFF, int(self.meters.received.per_s(now)))
        overtaken = acks.overtaken
        built = []
        for each in (overtaken, acks) if overtaken is not None and overtaken.pending else (acks,):
            delay_us = min((1 << 24) - 1, int(max(0.0, now - each.arrived_at) * 1e6))
            built.append(Ack(each.largest, each.received >> 1, delay_us, arriving, waiting))
        acks.on_ack_sent()
        return built

    def update_from(self, beat: Heartbeat, now: float) -> None:
        """Record what a heartbeat says about its sender."""
        if self.met_at is None:
            self.met_at = now
        self.peer_sends = (beat.send_rate, now)
        self.interval_s = beat.interval_ms / 1000
        self.versions = (beat.min_version, beat.max_version)
        self.features = beat.features
        self.clock_ms = beat.clock_ms
        self.path.timed = bool(beat.features & Feature.TIMED)
        self.path.compact = bool(beat.features & Feature.COMPACT)
        self.path.confirms = bool(beat.features & Feature.CONFIRM)
        self.path.versions = bool(beat.features & Feature.VERSIONS)
