"""The transport of one node: bytes and the time in; datagrams, events and one timer out. It never blocks, reads no
clock and opens nothing.

A driver repeats: `receive` what arrived, `handle_timer` when `next_timer` is due, then `datagrams_to_send` until it
returns none, then `next_event` until None.
"""

from collections.abc import Mapping
from types import MappingProxyType

from udp_mesh.core import publish, reconfigure, transmit
from udp_mesh.core.conditions import Conditions
from udp_mesh.core.events import Event, MessageDelivered, MessageId, Receipt, Rejected
from udp_mesh.core.interfaces import Background, Datagram, RandomSource, Store, in_foreground
from udp_mesh.core.legacy.acks import ReceivePosition
from udp_mesh.core.legacy.peers import LegacyPeers
from udp_mesh.core.logs.conditions import LogConditions
from udp_mesh.core.logs.messages import LOG_PREFIX
from udp_mesh.core.logs.store import LogStore, MemoryLogStore
from udp_mesh.core.logs.topics import with_log_topics
from udp_mesh.core.node_conditions import node_conditions
from udp_mesh.core.receive import receive_datagram
from udp_mesh.core.relaying.conditions import RelayConditions
from udp_mesh.core.relaying.relaying import Relaying
from udp_mesh.core.relaying.snapshot import snapshot
from udp_mesh.core.selective_sending import SelectiveSending
from udp_mesh.core.settings import Address, LinkInfo, Settings, Topic
from udp_mesh.core.shared_logs import SharedLogs
from udp_mesh.core.state import State
from udp_mesh.core.subscriptions.messages import TABLE_TOPIC, with_subscription_topics
from udp_mesh.core.thin.conditions import ThinConditions
from udp_mesh.core.thin.thin_links import ThinLinks
from udp_mesh.core.versions.conditions import VersionConditions
from udp_mesh.crypto.signing import SEED_BYTES
from udp_mesh.wire.header import MARK
from udp_mesh.wire.legacy import decapsulate
from udp_mesh.wire.limits import BOOT_ID_BYTES
from udp_mesh.wire.relay import RELAY_BYTE


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
        background: Background = in_foreground,
    ) -> None:
        """`now` is seconds on any clock that never runs backwards. `store` holds outboxes on disk (None: in memory),
        `log_store` the items of logs (None: in memory). `legacy_positions` are those of the previous run. `background`
        does the work that would hold up urgent messages."""
        if len(boot_id) != BOOT_ID_BYTES:
            raise ValueError(f"boot_id: expected {BOOT_ID_BYTES} bytes, found {len(boot_id)}")
        self._state = State(_with_reserved_topics(settings), boot_id, rng, now, store, background)
        self._legacy = LegacyPeers(self._state, legacy_positions)
        self._relaying = Relaying(self._state, now)
        self.selective = SelectiveSending(self._state, now)
        """What the programs here and at peers read."""
        self.thin = ThinLinks(self._state, now) if settings.thin.links else None
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

    def topic(self, name: str) -> Topic | None:
        """The settings of a topic; those of undeclared ones, if it is none of its own (None: it is refused)."""
        return self._state.topic(name)

    def receive(self, data: bytes | memoryview, link: str, source: Address, now: float) -> None:
        """Process one datagram. Bad bytes are counted and dropped; received data never makes this raise."""
        if self.thin is not None and link in self.thin.links:
            self.thin.receive(data, link, now)
            return
        if len(data) and data[0] < MARK:
            inner = decapsulate(data)
            if inner is not None:
                data = inner
        if len(data) and data[0] == RELAY_BYTE:
            self._relaying.receive(data, link, source, now)
        elif len(data) and data[0] < MARK and self._legacy.by_host:
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
        if self._legacy.by_host:
            out = self._legacy.encapsulate_broadcasts(out)
            self._legacy.send(now, out)
        if out:
            transmit.count_sent(self._state, out)
        return out if self.thin is None else out + self.thin.transmit(now)

    def next_timer(self) -> float | None:
        """When `handle_timer` is due next (None: never). Cheap; may be in the past."""
        at = transmit.next_timer(self._state)
        if at is None:
            return None
        at = min(at, self._relaying.next_at(), self.selective.next_at)
        if self.thin is not None:
            at = min(at, self.thin.next_at())
        if self._legacy.by_host:
            at = min(at, self._legacy.next_at())
        return at if self._logs is None else min(at, self._logs.next_at)

    def handle_timer(self, now: float) -> None:
        """Do what is due at `now`. Calling early or late is harmless."""
        transmit.handle_timer(self._state, now)
        self._relaying.handle_timer(now)
        self.selective.handle_timer(now)
        if self.thin is not None:
            self.thin.handle_timer(now)
        if self._legacy.by_host:
            self._legacy.handle_timer(now)

    @property
    def has_datagrams(self) -> bool:
        """Whether `datagrams_to_send` may return something. False right after it returned everything."""
        if self._logs is not None and self._logs.has_work:
            return True
        return bool(self._legacy.by_host) or self._relaying.has_work or transmit.has_datagrams(self._state)

    def is_due_before(self, at: float) -> bool:
        """Whether a call of `send` may have moved `next_timer` to before `at`; cheaper than reading that."""
        if self.thin is not None and self.thin.next_at() < at:
            return True
        soon = min(self._state.next_peer_at(), self._state.selection.next_at)
        return soon < at or bool(self._state.compression_queue.topics or self._state.versions.has_work)

    @property
    def is_quiet(self) -> bool:
        """Whether there is nothing to send and no event until `next_timer`, so that the driver may skip the node.

        True after most bulk datagrams, of which only every few request an acknowledgment.
        """
        if self._logs is not None and self._logs.has_work:
            return False
        return not self._legacy.by_host and not self._relaying.has_work and transmit.is_quiet(self._state)

    def next_event(self) -> Event | None:
        """The oldest event not yet fetched."""
        event = self._state.event_queue.next_event() if self._logs is None else self._logs.next_event()
        if self.thin is not None and isinstance(event, MessageDelivered):
            self.thin.sending.on_delivered(event)
        return event

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
        if self.thin is not None and self.thin.sending.carries(topic):
            return self.thin.sending.send(topic, payload, destination, type_name, now)
        return publish.send(self._state, topic, payload, destination, type_name, now)

    def link_up(self, link: LinkInfo, now: float) -> None:
        """A network attachment appeared, or changed its addresses or MTU (same name)."""
        reconfigure.link_up(self._state, link, now)

    def link_down(self, name: str, now: float) -> None:
        """The attachment is gone; its peers are reached over other links once they are heard there."""
        reconfigure.link_down(self._state, name)

    def apply(self, settings: Settings, now: float) -> list[str]:
        """Change topics, window, rates, limits, keys and neighbors. Returns one line per change made.

        Drops no accepted message, but changed thin links end what only they carry. Raises ValueError if the name or
        port changed: that requires a restart.
        """
        thin_changed = settings.thin != self._state.settings.thin
        lines = reconfigure.apply(self._state, _with_reserved_topics(settings), now)
        self.selective.apply()
        self._legacy.apply()
        self._relaying.apply(now)
        if thin_changed:
            if self.thin is not None:
                self.thin.sending.close()
            self.thin = ThinLinks(self._state, now) if settings.thin.links else None
            lines.append("thin links")
        elif self.thin is not None:
            self.thin.apply()
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

    def thin_conditions(self, now: float) -> ThinConditions | None:
        """A snapshot of thin links (None: there are none)."""
        return None if self.thin is None else self.thin.conditions(now)

    def versions(self) -> tuple[VersionConditions, ...]:
        """Versions sent and received, by topic."""
        return self._state.versions.conditions()

    def conditions(self, now: float) -> Conditions:
        """A snapshot for the autonomy, the status page and the metrics."""
        via = {route.name: route.via for route in self.relaying(now).routes if route.in_use}
        return node_conditions(self._state, now, via)

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

    @property
    def late_acknowledgements(self) -> int:
        """Acknowledgments so far that their receivers wanted sooner, because the driver reads too seldom for them."""
        return self._state.late_acknowledgements

    def legacy_positions(self) -> dict[str, ReceivePosition]:
        """The position of each legacy peer's messages. Save it: the next run needs it to keep their senders going."""
        return self._legacy.positions()

    def close(self, now: float) -> None:
        """Say goodbye; fetch the last datagrams and events afterwards. Pending reliable messages end as expired."""
        transmit.flush_packed(self._state, now)
        reconfigure.close(self._state, now)
        if self.thin is not None:
            self.thin.sending.close()
        if self._logs is not None:
            self._logs.process(now)


def _with_reserved_topics(settings: Settings) -> Settings:
    return with_subscription_topics(with_log_topics(settings))
