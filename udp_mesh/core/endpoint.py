"""The transport of one node: bytes and the time in; datagrams, events and one timer out. It never blocks, reads no
clock and opens nothing.

A driver repeats: `receive` what arrived, `handle_timer` when `next_timer` is due, then `datagrams_to_send` until it
returns none, then `next_event` until None.
"""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from types import MappingProxyType

from udp_mesh.core import publish, reconfigure, transmit
from udp_mesh.core.conditions import Conditions, PeerConditions, QueueConditions, UnverifiedNode
from udp_mesh.core.events import Event, MessageId, Receipt, Rejected
from udp_mesh.core.interfaces import Datagram, RandomSource, Store
from udp_mesh.core.legacy.acks import ReceivePosition
from udp_mesh.core.legacy.peers import LegacyPeers
from udp_mesh.core.logs.conditions import LogConditions
from udp_mesh.core.logs.messages import LOG_PREFIX
from udp_mesh.core.logs.store import LogStore, MemoryLogStore
from udp_mesh.core.logs.topics import with_log_topics
from udp_mesh.core.meter import Meter
from udp_mesh.core.peers.heartbeat import MISSED_HEARTBEATS
from udp_mesh.core.peers.session import Peer, Session
from udp_mesh.core.receive import receive_datagram
from udp_mesh.core.relaying.conditions import RelayConditions
from udp_mesh.core.relaying.relaying import Relaying
from udp_mesh.core.relaying.snapshot import snapshot
from udp_mesh.core.selective_sending import SelectiveSending
from udp_mesh.core.sender.send_state import SendState
from udp_mesh.core.sender.sender import Sender
from udp_mesh.core.settings import RELAY_LINK, Address, LinkInfo, Settings
from udp_mesh.core.shared_logs import SharedLogs
from udp_mesh.core.state import State
from udp_mesh.core.subscriptions.messages import TABLE_TOPIC, with_subscription_topics
from udp_mesh.core.versions.conditions import VersionConditions
from udp_mesh.crypto.signing import SEED_BYTES
from udp_mesh.wire.header import MARK
from udp_mesh.wire.legacy import decapsulate
from udp_mesh.wire.limits import BOOT_ID_BYTES
from udp_mesh.wire.relay import RELAY_BYTE

REPORTED_RATE_VALID_S = 2.0
"""A rate reported in an acknowledgement is valid for the second it averages, and one more."""

UNVERIFIED_AFTER_S = 3.0
"""A node heard for this long without hearing us is listed as unverified; discovery takes a fraction of that."""


class Endpoint:
    """The transport of one run of one named node. `boot_id` (16 random bytes, never used before) identifies the run."""

    def __init__(
        self,
        settings: Settings,
        *,
        boot_id: bytes,
        rng: RandomSource,
        now: float,
        store: Store | None = None,
        log_store: LogStore | None = None,
        legacy_positions: Mapping[str, ReceivePosition] = MappingProxyType({}),
    ) -> None:
        """`now` is seconds on any clock that never runs backwards. `store` holds outboxes on disk (None: in memory),
        `log_store` the items of logs (None: in memory). `legacy_positions` are those of the previous run."""
        if len(boot_id) != BOOT_ID_BYTES:
            raise ValueError(f"boot_id: expected {BOOT_ID_BYTES} bytes, found {len(boot_id)}")
        self._state = State(_with_reserved_topics(settings), boot_id, rng, now, store)
        self._legacy = LegacyPeers(self._state, legacy_positions)
        self._relaying = Relaying(self._state, now)
        self.selective = SelectiveSending(self._state, now)
        """What the programs here and at peers read."""
        self._log_store = log_store
        self._logs: SharedLogs | None = None
        self._start_logs(settings, now)
        reconfigure.restore_outboxes(self._state, now)

    def _start_logs(self, settings: Settings, now: float) -> None:
        """Once a topic is a log; a node without logs does no work for them."""
        if self._logs is None and any(topic.log is not None for topic in settings.topics):
            seed = self._state.rng.getrandbits(8 * SEED_BYTES).to_bytes(SEED_BYTES, "big")
            self._logs = SharedLogs(self._state, settings, self._log_store or MemoryLogStore(seed), now)

    @property
    def settings(self) -> Settings:
        """The settings in force."""
        return self._state.settings

    def receive(self, data: bytes | memoryview, link: str, source: Address, now: float) -> None:
        """Process one datagram. Bad bytes are counted and dropped; received data never makes this raise."""
        if len(data) and data[0] < MARK:
            inner = decapsulate(data)
            if inner is not None:
                data = inner
        if len(data) and data[0] == RELAY_BYTE:
            self._relaying.receive(data, link, source, now)
        elif len(data) and data[0] < MARK and self._legacy:
            self._legacy.receive(data, link, source, now)
        else:
            receive_datagram(self._state, data, link, source, now)

    def datagrams_to_send(self, now: float, *, max_bytes: int | None = None) -> list[Datagram]:
        """The datagrams to send now, most urgent first, about 64 KiB at most per call (`max_bytes`, if given).

        Call again while it `has_datagrams`. A driver whose socket is full limits `max_bytes`.
        """
        if self._logs is not None:
            self._logs.process(now)
        out = self._relaying.transmit(transmit.collect(self._state, now, max_bytes), now, max_bytes)
        if self._legacy:
            out = self._legacy.encapsulate_broadcasts(out)
            self._legacy.send(now, out)
        if out:
            transmit.count_sent(self._state, out)
        return out

    def next_timer(self) -> float | None:
        """When `handle_timer` is due next (None: never). Cheap; may be in the past."""
        at = transmit.next_timer(self._state)
        if at is None:
            return None
        at = min(at, self._relaying.next_at(), self.selective.next_at)
        if self._legacy:
            at = min(at, self._legacy.next_at())
        return at if self._logs is None else min(at, self._logs.next_at)

    def handle_timer(self, now: float) -> None:
        """Do what is due at `now`. Calling early or late is harmless."""
        transmit.handle_timer(self._state, now)
        self._relaying.handle_timer(now)
        self.selective.handle_timer(now)
        if self._legacy:
            self._legacy.handle_timer(now)

    @property
    def has_datagrams(self) -> bool:
        """Whether `datagrams_to_send` may return something. False right after it returned everything."""
        if self._logs is not None and self._logs.has_work:
            return True
        return bool(self._legacy) or self._relaying.has_work or transmit.has_datagrams(self._state)

    def is_due_before(self, at: float) -> bool:
        """Whether a call of `send` may have moved `next_timer` to before `at`; cheaper than reading that."""
        soon = min(self._state.next_peer_at(), self._state.selection.next_at)
        return soon < at or bool(self._state.compression_queue or self._state.versions.jobs)

    @property
    def is_quiet(self) -> bool:
        """Whether there is nothing to send and no event until `next_timer`, so that the driver may skip the node.

        True after most bulk datagrams, of which only every few request an acknowledgement.
        """
        if self._logs is not None and self._logs.has_work:
            return False
        return not self._legacy and not self._relaying.has_work and transmit.is_quiet(self._state)

    def next_event(self) -> Event | None:
        """The oldest event not yet fetched."""
        if self._logs is not None:
            return self._logs.next_event()
        return self._state.event_queue.next_event()

    def send(
        self, topic: str, payload: bytes, *, destination: str | None = None, now: float, type_name: str = ""
    ) -> MessageId | Rejected:
        """Accept a message for one peer, or (None) for the topic's destinations, or for all.

        For a reliable topic exactly one outcome event follows per destination. A message to all that fits one datagram
        is broadcast and has no outcome. A peer that was never discovered is `UNKNOWN_PEER` unless an outbox
        may hold the message.
        """
        if self._logs is not None and self._logs.is_log(topic):
            return self._logs.send(topic, payload, destination, type_name, now)
        return publish.send(self._state, topic, payload, destination, type_name, now)

    def link_up(self, link: LinkInfo, now: float) -> None:
        """A network attachment appeared, or changed its addresses or MTU (same name)."""
        reconfigure.link_up(self._state, link, now)

    def link_down(self, name: str, now: float) -> None:
        """The attachment is gone; its peers are reached over other links once they are heard there."""
        reconfigure.link_down(self._state, name)

    def apply(self, settings: Settings, now: float) -> list[str]:
        """Change topics, window, rates, limits, keys and neighbors. Returns one line per change made.

        Drops no accepted message. Raises ValueError if the name or port changed: that requires a restart.
        """
        lines = reconfigure.apply(self._state, _with_reserved_topics(settings), now)
        self.selective.apply()
        self._legacy.apply()
        self._relaying.apply(now)
        self._start_logs(settings, now)
        if self._logs is not None:
            self._logs.apply(settings, now)
        return [line for line in lines if not line.startswith((f"topic {LOG_PREFIX}", f"topic {TABLE_TOPIC}"))]

    def logs(self) -> tuple[LogConditions, ...]:
        """A snapshot of each shared log."""
        return () if self._logs is None else self._logs.conditions()

    def relaying(self, now: float) -> RelayConditions:
        """A snapshot of relays: who is reached through whom, what is passed on."""
        return snapshot(self._state, self._relaying, now)

    def versions(self) -> tuple[VersionConditions, ...]:
        """What was sent and received as versions, by topic."""
        return self._state.versions.conditions()

    def conditions(self, now: float) -> Conditions:
        """A snapshot for the autonomy, the status page and the metrics."""
        return _snapshot(self._state, now)

    def confirm(self, receipt: Receipt) -> None:
        """A received message is safe: the application took it, or it is on disk. Its sender reports it as delivered."""
        if self._logs is not None and self._logs.confirm(receipt):
            return
        session = self._state.peer_table.sessions.get(receipt.boot_id)
        if session is not None and session.receiver.confirm(receipt.message_id):
            self._state.schedule_control(session)

    def request_again(self, receipt: Receipt) -> None:
        """A received message could not be kept: its sender is to send it again."""
        if self._logs is not None and self._logs.request_again(receipt):
            return
        session = self._state.peer_table.sessions.get(receipt.boot_id)
        if session is not None and session.receiver.request_again(receipt.message_id):
            for refusal in session.receiver.refusals:
                session.queue_control(refusal)
            session.receiver.refusals.clear()
            self._state.schedule_control(session)

    def peer_addresses(self) -> dict[str, set[Address]]:
        """Link -> the addresses from which authenticated peers send: a driver reads what comes from elsewhere with less
        priority. It changes with the events of peers and with links."""
        addresses: dict[str, set[Address]] = {link.name: set() for link in self._state.own_links()}
        for peer in self._state.peer_table.online():
            if peer.session is not None and peer.session.path.link in addresses:
                addresses[peer.session.path.link].add(peer.session.path.address)
        for name, address in self._relaying.addresses():
            if name in addresses:
                addresses[name].add(address)
        return addresses

    @property
    def unauthenticated(self) -> int:
        """Datagrams so far without proof that a peer sent them: dropped ones, and those in the legacy format."""
        return self._state.event_queue.counters.dropped_unverified + self._legacy.accepted

    def legacy_positions(self) -> dict[str, ReceivePosition]:
        """What was received from each legacy peer. Save it: the next run needs it to keep their senders going."""
        return self._legacy.positions()

    def close(self, now: float) -> None:
        """Say goodbye; fetch the last datagrams and events afterwards. Pending reliable messages end as expired."""
        transmit.flush_packed(self._state, now)
        reconfigure.close(self._state, now)
        if self._logs is not None:
            self._logs.process(now)


def _with_reserved_topics(settings: Settings) -> Settings:
    return with_subscription_topics(with_log_topics(settings))


def _snapshot(state: State, now: float) -> Conditions:
    """See `Endpoint.conditions`."""
    idle = Sender(state.settings)
    peers = tuple(
        _peer_conditions(state, peer, peer.sender or idle, now) for _, peer in sorted(state.peer_table.peers.items())
    )
    senders = [peer.sender for peer in state.peer_table.peers.values() if peer.sender is not None]
    counters = state.event_queue.counters
    sent_bits_per_s = _bits_per_s(state.sent, now)
    receivers = [session.receiver for session in state.peer_table.sessions.values()]
    return Conditions(
        now,
        state.settings.name,
        peers,
        replace(
            counters,
            fragments_received=sum(receiver.fragments for receiver in receivers),
            duplicates_received=sum(receiver.duplicates for receiver in receivers),
            fragments_retransmitted=sum(sender.retransmitted for sender in senders),
            fragments_sent=sum(sender.sent_packets for sender in senders),
            dropped_stale=counters.dropped_stale + sum(receiver.expired for receiver in receivers),
            dropped_over_limit=counters.dropped_over_limit + sum(receiver.over_limit for receiver in receivers),
        ),
        sent_bits_per_s,
        sent_bits_per_s + sum(peer.peer_sends_bits_per_s or 0.0 for peer in peers if peer.online),
        sum(receiver.partial_bytes + receiver.inflating_bytes for receiver in receivers),
        sum(sender.levels.queued_bytes for sender in senders) + state.compression_queue.bytes,
        state.broadcasts.kept_bytes,
        tuple(_unverified_nodes(state, now)),
    )


def _unverified_nodes(state: State, now: float) -> Iterator[UnverifiedNode]:
    for session in sorted(state.peer_table.not_current(), key=lambda session: session.name):
        met_at, path = session.met_at, session.path
        if session.verified or met_at is None or now - met_at < UNVERIFIED_AFTER_S or not _recently_heard(session, now):
            continue
        yield UnverifiedNode(session.name, path.address, path.link, met_at, session.last_heard)


def _recently_heard(session: Session, now: float) -> bool:
    return now - session.last_heard < MISSED_HEARTBEATS * session.interval_s


def _peer_conditions(state: State, peer: Peer, sender: Sender, now: float) -> PeerConditions:
    session = peer.session
    held_messages, held_bytes = state.outboxes.count(peer.name)
    capacity = sender.congestion.capacity_packets_per_s()
    fragment_bytes = session.path.fragment_bytes if session is not None else state.settings.fragment_bytes
    capacity_bits_per_s = None if capacity is None else capacity * fragment_bytes * 8
    meters = session.meters if session is not None else peer.legacy_meters
    address, link, last_heard = _current_path(peer)
    saved = state.selection.saved(peer.name)
    return PeerConditions(
        peer.name,
        peer.online,
        peer.legacy,
        address,
        link,
        peer.online_since,
        last_heard,
        sender.rtt.smoothed_rtt,
        sender.rtt.min_rtt,
        sender.loss,
        _bits_per_s(meters.sent, now) if meters is not None else 0.0,
        _bits_per_s(meters.delivered, now) if meters is not None else 0.0,
        _bits_per_s(meters.received, now) if meters is not None else 0.0,
        _reported_bits_per_s(session.peer_receives, REPORTED_RATE_VALID_S, now) if session is not None else None,
        _reported_bits_per_s(session.peer_sends, MISSED_HEARTBEATS * session.interval_s, now)
        if session is not None
        else None,
        capacity_bits_per_s,
        sender.congestion.cwnd,
        sender.in_flight.outstanding,
        sender.retransmitted,
        _queue_conditions(sender, now, capacity_bits_per_s if peer.online else None),
        held_messages,
        held_bytes,
        session is not None and session.one_way_since is not None and _recently_heard(session, now),
        now - sender.last_progress if sender.state is SendState.UNRESPONSIVE and sender.pending else None,
        sender.sent_bytes,
        sender.delivered_bytes,
        session.received_bytes if session is not None else meters.received.total if meters is not None else 0,
        saved.messages,
        saved.bytes,
    )


def _current_path(peer: Peer) -> tuple[Address | None, str | None, float | None]:
    """Address, link, and when something last came from there."""
    session = peer.session
    if session is not None:
        path = session.path
        if path.link == RELAY_LINK:
            # Its address there means nothing outside.
            return None, path.link, session.last_heard
        return (path.address, path.link, session.last_heard) if path.link else (None, None, session.last_heard)
    return peer.legacy_path or (None, None, None)


def _queue_conditions(sender: Sender, now: float, capacity_bits_per_s: float | None) -> tuple[QueueConditions, ...]:
    queues = []
    waiting_bytes = 0
    for priority, level in enumerate(sender.levels):
        waiting_bytes += level.bytes
        oldest = level.oldest()
        starved_s = level.starved_s + (now - level.starved_since if level.starved_since is not None else 0.0)
        if not level.messages and not starved_s and not level.held_s:
            continue
        queues.append(
            QueueConditions(
                priority,
                level.messages,
                level.bytes,
                now - oldest.queued_at if oldest is not None else 0.0,
                starved_s,
                level.held_s,
                waiting_bytes * 8 / capacity_bits_per_s if capacity_bits_per_s else None,
            )
        )
    return tuple(queues)


def _reported_bits_per_s(rate: tuple[int, float], for_s: float, now: float) -> float | None:
    """The rate in bits per second that a peer reported, unless the report is too old."""
    bytes_per_s, reported_at = rate
    return 8.0 * bytes_per_s if now - reported_at <= for_s else None


def _bits_per_s(meter: Meter, now: float) -> float:
    return 8 * meter.per_s(now)
