"""Connects the thin links with the node: frames in and out, and the messages in them.

1. `sending` takes messages of marked topics and queues them on their links.
2. `transmit` composes, seals and returns frames; `receive` opens them.
3. The first copy of a message becomes an event, whichever link brought it, and is acknowledged.
"""

from __future__ import annotations

from functools import partial

from udp_mesh.core.events import MessageReceived, ThinLinkRejecting, ThinPeerHeard, ThinPeerSilent
from udp_mesh.core.interfaces import Datagram
from udp_mesh.core.settings import Topic
from udp_mesh.core.state import State
from udp_mesh.core.thin.airtime import AirtimeBudget
from udp_mesh.core.thin.conditions import ThinConditions, ThinLinkConditions, ThinPeerConditions
from udp_mesh.core.thin.link import ANSWER_FRAMES, ComposedFrame, ThinLink
from udp_mesh.core.thin.peers import Opened, ThinPeer, ThinPeers, Verdict
from udp_mesh.core.thin.reassembly import ThinReassembly
from udp_mesh.core.thin.sending import ThinSending
from udp_mesh.crypto.thin import ThinChannel, thin_hint
from udp_mesh.wire.errors import DecodeError
from udp_mesh.wire.limits import HEARD_TAG_BYTES
from udp_mesh.wire.thin import THIN_TAG_BYTES, Part, ThinAck, decode_body, encode_header, topic_hash

MAINTENANCE_S = 1.0
FIRST_WITHIN_FRAMES = 20
"""The first presence is sent within the airtime of so many short frames."""
INTRODUCTION_GAP_S = 10.0
"""Between two answers to nodes that are not proven: recorded introductions must not use up the budget."""
_COUNTER_OF = {
    Verdict.ACCEPTED: "frames_received",
    Verdict.FOREIGN: "frames_foreign",
    Verdict.UNPROVEN: "frames_unproven",
    Verdict.REPLAYED: "frames_replayed",
    Verdict.FORGED: "frames_forged",
    Verdict.MALFORMED: "frames_malformed",
}


class ThinLinks:
    """The thin links of one node."""

    def __init__(self, state: State, now: float) -> None:
        settings = state.settings.thin
        assert settings.number is not None
        self._state = state
        self._number = settings.number
        self._tag = state.boot_id[:HEARD_TAG_BYTES]
        self.peers = ThinPeers(state.keys, state.settings.name, self._number, self._tag)
        self.reassembly = ThinReassembly()
        self.links = {
            link.name: ThinLink(
                link,
                AirtimeBudget(link, now),
                state.rng,
                state.settings.name,
                settings.presence_s,
                self._arrived,
            )
            for link in settings.links
        }
        for link in self.links.values():
            # At random: a whole team may start at once.
            link.introduce_soon(now, FIRST_WITHIN_FRAMES * link.short_s())
        self.sending = ThinSending(state, self.links, self.peers)
        self._present: dict[int, str] = {}
        """Names of the nodes reported as heard, by number."""
        self._topics: dict[bytes, Topic] = {}
        self._maintenance_at = now
        self._unknown_topics = 0
        self._set_keys()
        self._set_topics()

    def apply(self) -> None:
        """Take over changed topics and keys."""
        self._set_keys()
        self._set_topics()

    def _set_keys(self) -> None:
        key = self._state.keys[0]
        self._hint, self._channel = thin_hint(key), ThinChannel(key, self._tag, self._number)
        self.peers.set_keys(self._state.keys)

    def _set_topics(self) -> None:
        self._topics = {topic_hash(name): topic for name, topic in self._state.topics.items() if topic.thin}

    # Frames in

    def receive(self, frame: bytes | memoryview, link_name: str, now: float) -> None:
        """Process one frame. Never raises, whatever arrives."""
        link = self.links[link_name]
        if link.forgeries.rejects(now):
            link.counters.frames_rejected += 1
            return
        opened = self.peers.receive(bytes(frame), link_name, now)
        counter = _COUNTER_OF[opened.verdict]
        setattr(link.counters, counter, getattr(link.counters, counter) + 1)
        if opened.verdict is Verdict.FORGED and link.forgeries.on_failure(now):
            self._state.event_queue.emit(ThinLinkRejecting(link_name, link.forgeries.failures))
        parts = [item for item in opened.items if isinstance(item, Part)]
        link.on_heard(now, more_follows=any(part.position + 1 < part.parts for part in parts))
        self._answer(link, opened, now)
        if opened.verdict is not Verdict.ACCEPTED or opened.peer is None:
            return
        self._on_present(opened, opened.peer, now)
        for item in opened.items:
            if isinstance(item, ThinAck) and item.number == self._number:
                self.sending.on_ack(opened.peer, item, now)
            elif isinstance(item, Part):
                self._on_part(link, opened.peer, item, now)

    def _answer(self, link: ThinLink, opened: Opened, now: float) -> None:
        """Introduce this node to one that cannot know yet that it is heard."""
        if opened.met_at is None:
            return
        within_s = 4 * link.short_s() * (1 + len(self.peers.peers))
        if link.introduced_at <= opened.met_at:
            link.introduce_soon(now, within_s)
        elif opened.verdict is Verdict.UNPROVEN:
            link.introduce_soon(max(now, link.introduced_at + INTRODUCTION_GAP_S), within_s)

    def _on_present(self, opened: Opened, peer: ThinPeer, now: float) -> None:
        """The node is heard; perhaps it was not before, or has restarted."""
        if not peer.is_present(now) or (peer.number in self._present and not opened.proven):
            return
        self._present[peer.number] = peer.name
        self._state.event_queue.emit(ThinPeerHeard(peer.name, next(reversed(peer.links), "")))
        self.sending.on_appeared(peer, now)

    def _arrived(self, number: int, message: int) -> int:
        peer = self.peers.peers.get(number)
        return 0 if peer is None or peer.boot is None else self.reassembly.arrived(peer.boot.tag, message)

    def _on_part(self, link: ThinLink, peer: ThinPeer, part: Part, now: float) -> None:
        if part.destination not in (None, self._number) or peer.boot is None:
            return
        tag, urgent = peer.boot.tag, part.priority <= self._state.settings.rates.urgent_priority
        crowd = 1 if part.destination is not None else max(1, len(self._present))
        acknowledge = partial(
            link.acknowledge,
            peer.number,
            part.message,
            urgent=urgent,
            within_s=ANSWER_FRAMES * (crowd - 1) * link.short_s(),
            now=now,
        )
        if self._state.thin_copies.knows(tag, part.message):
            # All of it is here, perhaps over another link; its sender has not heard of that.
            self._state.thin_copies.dropped += part.position == 0
            if part.reliable:
                acknowledge(complete=True)
            return
        whole = self.reassembly.receive(tag, part, now)
        topic = None if whole is None else self._topics.get(whole[0].topic or b"")
        if whole is not None and topic is None:
            # Not acknowledged: its sender is to report that it was not delivered.
            self._unknown_topics += 1
            return
        if part.reliable:
            acknowledge(complete=whole is not None)
        if whole is not None and topic is not None and self._state.thin_copies.is_first(tag, part.message):
            self._deliver(peer, topic, *whole)

    def _deliver(self, peer: ThinPeer, topic: Topic, first: Part, joined: bytes) -> None:
        counters = self._state.event_queue.counters
        try:
            body = decode_body(joined)
        except DecodeError:
            counters.dropped_malformed += 1
            return
        counters.messages_received += 1
        to_all = first.destination is None
        self._state.event_queue.emit(
            MessageReceived(peer.name, topic.name, body.type_name, body.payload, first.priority, to_all)
        )

    # Frames out

    def transmit(self, now: float) -> list[Datagram]:
        """The frames to send now: one for each link that is free and has something to send."""
        out = []
        for name, link in self.links.items():
            if now < link.next_at():
                continue
            composed = link.compose(self.peers.heard(now), now)
            if composed is not None:
                self.sending.on_composed(composed, now)
                out.append(Datagram(name, None, self._seal(composed, now), composed.urgent))
        return out

    def _seal(self, composed: ComposedFrame, now: float) -> bytes:
        tag = self._tag if composed.introduction else None
        counter = self._state.thin_counter
        self._state.thin_counter += 1
        header = encode_header(self._hint, self._number, counter, tag)
        frame = self._channel.seal(header, composed.items, counter)
        if composed.introduction:
            self.peers.on_introduction_sent(frame[-THIN_TAG_BYTES:], now)
        return frame

    def next_at(self) -> float:
        """When `handle_timer` or `transmit` is due next."""
        return min(self._maintenance_at, min(link.next_at() for link in self.links.values()))

    def handle_timer(self, now: float) -> None:
        """Do what is due at `now`."""
        if now < self._maintenance_at:
            return
        self._maintenance_at = now + MAINTENANCE_S
        self.peers.expire(now)
        self.reassembly.expire(now)
        for number in list(self._present):
            peer = self.peers.peers.get(number)
            if peer is None or not peer.is_present(now):
                self._state.event_queue.emit(ThinPeerSilent(self._present.pop(number)))
        self.sending.expire(now)
        self.sending.hand_over(now)

    def set_up(self, name: str, up: bool, now: float) -> None:
        """The link's device is there, or not."""
        link = self.links[name]
        if up and not link.up:
            link.introduce_soon(now, 1.0)
        link.up = up

    # Conditions

    def conditions(self, now: float) -> ThinConditions:
        """A snapshot."""
        return ThinConditions(
            self._number,
            tuple(_link_conditions(link, now) for link in self.links.values()),
            tuple(
                ThinPeerConditions(
                    peer.name,
                    peer.number,
                    tuple(peer.links),
                    now - peer.heard_at,
                    peer.is_present(now),
                    self.sending.is_only_thin(peer),
                    peer.conflicting_name,
                )
                for peer in sorted(self.peers.peers.values(), key=lambda peer: peer.name)
                if peer.boot is not None
            ),
            self.peers.own_number_used_by,
            self._state.thin_copies.dropped,
            self._unknown_topics,
            self.sending.too_large,
        )


def _link_conditions(link: ThinLink, now: float) -> ThinLinkConditions:
    settings = link.settings
    rejecting = link.forgeries.rejects(now)
    return ThinLinkConditions(
        settings.name,
        link.up,
        settings.bits_per_s,
        settings.largest_frame_bytes,
        link.budget.limit_s,
        settings.window_s,
        link.budget.burst_s,
        link.budget.available_s(now),
        link.budget.total_s,
        link.blocked_until - now if link.blocked_until > now else None,
        len(link.queue),
        link.forgeries.ends_in_s(now) if rejecting else None,
        link.forgeries.failures,
        link.counters,
    )
