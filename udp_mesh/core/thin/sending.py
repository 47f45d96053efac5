"""Messages of thin topics out: to the datagram links as ever, and to thin links, each with its outcome once.

Urgent messages take all their links at once; others take thin links while some receiver is not online elsewhere. A
message for a node that only thin links reach takes the others as soon as it is online there (`hand_over`). All copies
carry one number, by which receivers drop those that come later. An acknowledgment on a thin link ends the message on
the datagram links for that receiver, and a datagram that was delivered ends it on thin links.
"""

from __future__ import annotations

from collections.abc import Mapping

from udp_mesh.core import publish
from udp_mesh.core.events import ExpiryReason, MessageDelivered, MessageExpired, MessageId, Rejected, RejectReason
from udp_mesh.core.settings import Topic
from udp_mesh.core.state import State
from udp_mesh.core.thin.link import ComposedFrame, ThinLink
from udp_mesh.core.thin.outgoing import LIFE_S, ThinMessage, divide
from udp_mesh.core.thin.peers import ThinPeer, ThinPeers
from udp_mesh.wire.thin import ThinAck, ThinBody, encode_body, topic_hash

MAX_MESSAGES = 256
"""Messages that may still be sent or acknowledged; the oldest ones end for a new one."""


class ThinSending:
    """See the module's docstring."""

    def __init__(self, state: State, links: Mapping[str, ThinLink], peers: ThinPeers) -> None:
        self._state, self._links, self._peers = state, links, peers
        self._next_number = state.rng.getrandbits(16)
        self._messages: list[ThinMessage] = []
        """Those that may still be sent or acknowledged."""
        self._sent_at: dict[str, float] = {}
        """When each topic was last sent."""
        self.too_large = 0

    def carries(self, topic: str) -> bool:
        """Whether messages of this topic go to thin links."""
        found = self._state.topics.get(topic)
        return found is not None and found.thin

    def send(
        self, topic_name: str, payload: bytes, destination: str | None, type_name: str, now: float
    ) -> MessageId | Rejected:
        """See `Endpoint.send`."""
        number = self._next_number
        topic = self._state.topics[topic_name]
        outcome = publish.send(self._state, topic_name, payload, destination, type_name, now, thin_number=number)
        alone = isinstance(outcome, Rejected) and outcome.reason is RejectReason.UNKNOWN_PEER
        if isinstance(outcome, Rejected):
            if not alone or destination is None or self._peers.named(destination) is None:
                return outcome
            outcome = MessageId(self._state.next_message_id)
            self._state.next_message_id += 1
            self._state.event_queue.counters.messages_sent += 1
        self._next_number = number + 1 & 0xFFFF
        names: tuple[str | None, ...] = (destination,) if destination is not None else topic.destinations or (None,)
        body = ThinBody(type_name, payload)
        for name in names:
            if name != self._state.settings.name:
                self._send(number, outcome, topic, body, name, now, alone=alone)
        return outcome

    def _send(
        self,
        number: int,
        message_id: MessageId,
        topic: Topic,
        body: ThinBody,
        destination: str | None,
        now: float,
        *,
        alone: bool,
    ) -> None:
        """Queue one destination's copy (None: all) on the topic's links."""
        to = None if destination is None else self._peers.named(destination)
        if destination is not None and to is None:
            return
        urgent = topic.priority <= self._state.settings.rates.urgent_priority
        receivers = self._peers.present(now) if to is None else [to]
        needing = [peer for peer in receivers if urgent or self.is_only_thin(peer)]
        links = self._links_of(topic)
        if not links or not (urgent or needing):
            return
        parts = divide(encode_body(body), min(link.part_bytes for link in links))
        if parts is None:
            self.too_large += 1
            if alone:
                self._expired(message_id, destination or "", topic, ExpiryReason.TOO_LARGE)
            return
        message = ThinMessage(
            number,
            message_id,
            topic.name,
            topic_hash(topic.name),
            topic.priority,
            urgent,
            topic.reliable,
            None if to is None else to.number,
            parts,
            now,
            now + (LIFE_S if topic.deadline_s is None else topic.deadline_s),
            alone=body if alone else None,
        )
        if topic.thin_period_s is not None:
            message.not_before = self._sent_at.get(topic.name, float("-inf")) + topic.thin_period_s
        for peer in needing:
            message.add_receiver(peer.number)
        self._make_room(topic, message)
        self._messages.append(message)
        for link in links:
            link.push(message)

    def _links_of(self, topic: Topic) -> list[ThinLink]:
        return [link for name, link in self._links.items() if not topic.links or name in topic.links]

    def _make_room(self, topic: Topic, message: ThinMessage) -> None:
        """End the messages that a newer one replaces."""
        if len(self._messages) >= MAX_MESSAGES:
            self._end(self._messages.pop(0), ExpiryReason.SUPERSEDED)
        if topic.keep_last is None and topic.thin_period_s is None:
            return
        same = [
            waiting
            for waiting in self._messages
            if waiting.topic == topic.name and waiting.destination == message.destination and not waiting.ended
        ]
        for old in same[: max(0, len(same) + 1 - (topic.keep_last or 1))]:
            self._end(old, ExpiryReason.SUPERSEDED)

    def is_only_thin(self, peer: ThinPeer) -> bool:
        """Whether no other link reaches the node."""
        known = self._state.peer_table.peers.get(peer.name)
        return known is None or not known.online

    def on_appeared(self, peer: ThinPeer, now: float) -> None:
        """A node is new here, or has restarted: urgent messages that are still worth it go to it as well."""
        for message in self._messages:
            topic = self._state.topics.get(message.topic)
            for_it = message.destination in (None, peer.number) and not message.ended and now < message.ends_at
            if topic is not None and for_it and message.urgent:
                message.acknowledged.discard(peer.number)
                message.add_receiver(peer.number)
                for link in self._links_of(topic):
                    link.repeat(message)

    def on_composed(self, composed: ComposedFrame, now: float) -> None:
        """Parts of messages are being sent."""
        for message in composed.messages:
            self._sent_at[message.topic] = now

    def hand_over(self, now: float) -> None:
        """Reliable messages that only thin links carried so far take the datagram links as well, once their receiver
        is online there."""
        for message in self._messages:
            peer = None if message.destination is None else self._peers.peers.get(message.destination)
            if message.alone is None or message.ended or not message.reliable or peer is None:
                continue
            if not self.is_only_thin(peer) and publish.send_later(
                self._state,
                message.message_id,
                message.topic,
                message.alone,
                peer.name,
                accepted_at=message.accepted_at,
                thin_number=message.number,
                now=now,
            ):
                message.alone = None

    def expire(self, now: float) -> None:
        """End what has taken too long."""
        for message in self._messages:
            if now >= message.ends_at:
                self._end(message, ExpiryReason.DEADLINE)
        self._messages = [message for message in self._messages if not message.ended]

    def close(self) -> None:
        """The node closes: what only thin links carry ends here."""
        for message in self._messages:
            self._end(message, ExpiryReason.CLOSED)

    # Outcomes

    def _end(self, message: ThinMessage, reason: ExpiryReason) -> None:
        topic = self._state.topics.get(message.topic)
        if not message.ended and message.alone is not None and topic is not None:
            for number in message.lacking:
                peer = self._peers.peers.get(number)
                self._expired(message.message_id, "" if peer is None else peer.name, topic, reason)
        message.ended = True

    def _expired(self, message_id: MessageId, peer: str, topic: Topic, reason: ExpiryReason) -> None:
        self._state.event_queue.counters.messages_expired += 1
        if topic.reliable:
            self._state.event_queue.emit(MessageExpired(message_id, peer, topic.name, reason))

    def on_delivered(self, event: MessageDelivered) -> None:
        """Another link delivered a message: thin links need not."""
        peer = self._peers.named(event.peer)
        for message in self._messages:
            if peer is not None and message.message_id == event.message_id:
                message.lacking.pop(peer.number, None)
                message.acknowledged.add(peer.number)

    def on_ack(self, peer: ThinPeer, ack: ThinAck, now: float) -> None:
        """A receiver has a message, or parts of it."""
        for message in self._messages:
            if message.number != ack.message or peer.number not in message.lacking:
                continue
            if ack.parts is not None:
                progress = bool(ack.parts & ~message.lacking[peer.number])
                message.lacking[peer.number] = ack.parts
                for link in self._links.values() if progress else ():
                    link.on_progress(message, now)
                continue
            del message.lacking[peer.number]
            message.acknowledged.add(peer.number)
            topic = self._state.topics.get(message.topic)
            if message.alone is not None:
                self._state.event_queue.counters.messages_delivered += 1
                latency_s = now - message.accepted_at
                self._state.event_queue.emit(MessageDelivered(message.message_id, peer.name, message.topic, latency_s))
            elif topic is None or not topic.keeps_on_disk:
                publish.delivered_elsewhere(self._state, peer.name, message.message_id, now)
            if message.is_answered and (message.destination is not None or not message.urgent):
                message.ended = True
