"""Connects the shared logs with the rest of a node: events of the transport in, messages and events out.

`process` takes the events that the transport queued: those about logs go to the `Replicator`, all others wait for
`next_event`. Nodes of earlier versions get items as ordinary messages from their source, while they are online.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

from udp_mesh.core import publish
from udp_mesh.core.event_queue import EventQueue
from udp_mesh.core.events import (
    Event,
    MessageDelivered,
    MessageExpired,
    MessageId,
    MessagePeerLost,
    MessageReceived,
    PeerOffline,
    PeerOnline,
    PeerRestarted,
    Receipt,
    Rejected,
    RejectReason,
    TopicStarved,
)
from udp_mesh.core.legacy.sender import can_publish
from udp_mesh.core.link_strength import LinkStrength
from udp_mesh.core.logs.conditions import LogConditions
from udp_mesh.core.logs.delivery import LOG_RECEIPT
from udp_mesh.core.logs.messages import CONTROL_TOPIC
from udp_mesh.core.logs.replicator import Replicator
from udp_mesh.core.logs.store import LogStore
from udp_mesh.core.logs.topics import is_log_traffic, log_of
from udp_mesh.core.peers.heartbeat import MISSED_HEARTBEATS
from udp_mesh.core.peers.session import Session
from udp_mesh.core.settings import LinkKind, Settings, Topic
from udp_mesh.core.state import State
from udp_mesh.wire.frames import Feature

SYNC_S = 1.0
"""Interval at which peers are checked for a changed feature: a running node may get its first log."""

SILENT_S = 3.5
"""A peer not heard for this long is probably out of reach, long before it is offline: robots meet for seconds."""


class SharedLogs:
    """The logs of one node."""

    def __init__(self, state: State, settings: Settings, store: LogStore, now: float) -> None:
        self._state = state
        self._events = EventQueue(settings.limits.events)
        self._sync_at = now
        self._strengths: dict[str, LinkStrength] = {}
        """By peer with logs."""
        self._plain: dict[MessageId, MessageId] = {}
        """Copies of items sent as ordinary messages: their id -> the item's."""
        self.replicator = Replicator(
            settings,
            store,
            send=self._send,
            withdraw=partial(publish.withdraw, state),
            emit=self._events.emit,
            next_message_id=self._next_message_id,
            now=now,
        )

    def apply(self, settings: Settings, now: float) -> None:
        """Take over changed settings."""
        self._events.set_limit(settings.limits.events)
        self.replicator.apply(settings, now)

    def is_log(self, topic: str) -> bool:
        return topic in self.replicator.policy.topics

    def send(
        self, topic: str, payload: bytes, destination: str | None, type_name: str, now: float
    ) -> MessageId | Rejected:
        """See `Endpoint.send`."""
        settings = self.replicator.policy.topics[topic]
        if self._state.closed:
            return Rejected(RejectReason.CLOSED, "the node is closed")
        if destination is not None:
            return Rejected(
                RejectReason.UNKNOWN_PEER, f"topic {topic} is a log: its items go to its readers, not to {destination}"
            )
        if len(payload) > self._state.settings.limits.message_bytes:
            limit = self._state.settings.limits.message_bytes
            return Rejected(RejectReason.TOO_LARGE, f"expected at most {limit} bytes, found {len(payload)}")
        if publish.topic_channel(self._state, settings, type_name) is None:
            return Rejected(RejectReason.UNKNOWN_TOPIC, "too many topics, or the type name is not printable text")
        outcome = self.replicator.append(topic, payload, type_name, now)
        if not isinstance(outcome, Rejected):
            self._send_plain(settings, payload, type_name, outcome, now)
        return outcome

    def confirm(self, receipt: Receipt) -> bool:
        """Whether the receipt was one of an item."""
        if receipt.boot_id == LOG_RECEIPT:
            self.replicator.holdings.confirm(receipt)
        return receipt.boot_id == LOG_RECEIPT

    def request_again(self, receipt: Receipt) -> bool:
        """Whether the receipt was one of an item."""
        if receipt.boot_id == LOG_RECEIPT:
            self.replicator.holdings.request_again(receipt)
        return receipt.boot_id == LOG_RECEIPT

    @property
    def has_work(self) -> bool:
        return self.replicator.has_work or self._events.has_events

    @property
    def next_at(self) -> float:
        return min(self.replicator.next_at, self._sync_at)

    def next_event(self) -> Event | None:
        return self._events.next_event()

    def conditions(self) -> tuple[LogConditions, ...]:
        return self.replicator.conditions()

    def process(self, now: float) -> None:
        """Take the transport's events, then do what is due."""
        queue = self._state.event_queue
        while (event := queue.next_event()) is not None:
            self._route(event, now)
        if now >= self._sync_at:
            self._sync_at = now + SYNC_S
            self._sync(now)
        self.replicator.run(now)
        # What was sent may have ended at once.
        while (event := queue.next_event()) is not None:
            self._route(event, now)

    def _route(self, event: Event, now: float) -> None:
        logs = self.replicator
        match event:
            case PeerOnline(peer) | PeerRestarted(peer):
                if self._has_logs(peer):
                    logs.peer_online(peer, now)
            case PeerOffline(peer):
                self._strengths.pop(peer, None)
                logs.peer_offline(peer)
            case MessageReceived(source, topic, _, payload) if is_log_traffic(topic):
                log = log_of(topic)
                if log is None:
                    logs.on_control(source, payload, now)
                else:
                    logs.on_item(source, log, payload, now)
                return
            case MessageDelivered() | MessageExpired() | MessagePeerLost():
                if is_log_traffic(event.topic):
                    logs.on_outcome(event.message_id)
                    return
                item = self._plain.pop(event.message_id, None)
                if item is not None:
                    event = replace(event, message_id=item)
            case TopicStarved(_, topic) if is_log_traffic(topic):
                event = replace(event, topic=log_of(topic) or CONTROL_TOPIC)
            case _:
                pass
        self._events.emit(event)

    def _session(self, name: str) -> Session | None:
        """The session of an online peer that takes part in logs."""
        peer = self._state.peer_table.peers.get(name)
        if peer is None or not peer.online or peer.session is None or not peer.session.features & Feature.LOGS:
            return None
        return peer.session

    def _has_logs(self, name: str) -> bool:
        return self._session(name) is not None

    def _sync(self, now: float) -> None:
        for peer in self._state.peer_table.online():
            if peer.name not in self.replicator.peers and self._has_logs(peer.name):
                self.replicator.peer_online(peer.name, now)
        for name in list(self.replicator.peers):
            session = self._session(name)
            if session is None:
                self._strengths.pop(name, None)
                self.replicator.peer_offline(name)
            else:
                silent_s = max(SILENT_S, MISSED_HEARTBEATS * session.interval_s)
                self.replicator.peer_silent(name, now - session.last_heard > silent_s)
                self.replicator.peer_weak(name, self._is_weak(name, session, now), now)

    def _is_weak(self, name: str, session: Session, now: float) -> bool:
        """Whether much of what the peer sends to all is lost. Neighbors get copies with numbers of their own, which do
        not show it."""
        link = self._state.links.get(session.path.link)
        if link is None or link.kind is not LinkKind.BROADCAST:
            return False
        strength = self._strengths.get(name)
        if strength is None or strength.session is not session:
            strength = self._strengths[name] = LinkStrength(session)
        return strength.is_weak(now)

    def _send(self, topic: str, payload: bytes, destination: str | None, now: float) -> MessageId | Rejected:
        return publish.send(self._state, topic, payload, destination, "", now)

    def _send_plain(self, topic: Topic, payload: bytes, type_name: str, item: MessageId, now: float) -> None:
        """To readers that speak an earlier version, or the legacy format."""
        readers = () if topic.log is None else topic.log.readers
        for peer in self._state.peer_table.online():
            if (readers and peer.name not in readers) or self._has_logs(peer.name):
                continue
            if peer.legacy and not can_publish(type_name):
                continue
            copy = publish.send(self._state, topic.name, payload, peer.name, type_name, now)
            if not isinstance(copy, Rejected):
                self._plain[copy] = item

    def _next_message_id(self) -> MessageId:
        message_id = MessageId(self._state.next_message_id)
        self._state.next_message_id += 1
        return message_id
