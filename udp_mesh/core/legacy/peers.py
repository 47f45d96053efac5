"""Peers that speak the legacy format, each named in the configuration. Both directions, with priorities.

A legacy datagram is accepted only from a configured address and under the configured name: what it claims about itself
is not authenticated. Heartbeats, offline detection, queues and outcomes work as for other peers.

Upgrades are detected: once a node of our own format is verified under the configured name, it is that peer, whatever
the configuration says, and the legacy format is no longer spoken with it. Pending messages restart (`peer_lifecycle`).
Broadcasts stay encapsulated while the configuration names any legacy peer.
"""

from collections.abc import Mapping

from udp_mesh.core.events import MessageReceived, PeerOffline, PeerOnline
from udp_mesh.core.interfaces import Datagram, RandomSource
from udp_mesh.core.legacy.acks import LegacyAcks, ReceivePosition
from udp_mesh.core.legacy.reassembly import LegacyReassembly
from udp_mesh.core.legacy.sender import LegacySender
from udp_mesh.core.peers.peer_state import PeerEvent, PeerState
from udp_mesh.core.peers.session import STALE_PATH_S, Meters, Peer
from udp_mesh.core.publish import release_outbox, report_ended, store_in_outbox
from udp_mesh.core.sender.path import IP_UDP_BYTES
from udp_mesh.core.sender.pending import Outcome
from udp_mesh.core.settings import Address, LinkInfo, Neighbour, Settings
from udp_mesh.core.state import SUSPENDED_S, State
from udp_mesh.wire.errors import DecodeError
from udp_mesh.wire.legacy import (
    Host,
    LegacyAck,
    LegacyPayload,
    PriorityMeshData,
    decode_legacy,
    encapsulate,
    encode_legacy,
    is_ros_name,
    is_ros_type,
)
from udp_mesh.wire.limits import PRIORITY_LEVELS

LEGACY_HEARTBEAT_S = 1.0
"""The legacy heartbeat period; legacy receivers report a peer offline after ten."""

RESTARTED_AFTER_S = 3.5
"""After this long without a datagram a legacy program may have been restarted: it sends a heartbeat every second."""

SETTLE_S = 10.0
"""After its first heartbeat, how long outboxes wait before they send: the program acknowledges from the start, but what
arrives before its reader has subscribed is lost (which takes long on a slow computer)."""

MAX_TOPICS = 256
"""Topics of one legacy peer: nothing it sends is authenticated, and each may become a ROS topic here."""


class LegacyPeer:
    """One legacy peer."""

    __slots__ = (
        "_upgraded",
        "acks",
        "address",
        "broadcasts",
        "last_heard",
        "link",
        "link_heard_at",
        "meters",
        "neighbour",
        "own_host",
        "peer",
        "received_bytes",
        "sender",
        "settled_at",
        "topics",
        "unicasts",
    )

    def __init__(
        self,
        neighbour: Neighbour,
        peer: Peer,
        settings: Settings,
        rng: RandomSource,
        position: ReceivePosition | None,
    ) -> None:
        self.neighbour = neighbour
        self.peer = peer
        self.address = neighbour.address
        self.link = neighbour.link or ""
        self.link_heard_at = float("-inf")
        self.own_host: str | None = None
        """The address of ours that fragments were last sent from."""
        self.sender = LegacySender(peer.open_sender(), settings.name, rng.getrandbits(15))
        self.unicasts = LegacyReassembly(settings.limits)
        self.broadcasts = LegacyReassembly(settings.limits)
        self.last_heard = float("-inf")
        self.acks = LegacyAcks(position)
        self.settled_at: float | None = None
        """When outboxes may send; None: they do already."""
        self.topics: set[str] = set()
        self.received_bytes = 0
        self.meters = peer.legacy_meters = Meters(0.0)
        self._upgraded = False

    def is_upgraded(self) -> bool:
        """Whether a node of our own format has taken its place."""
        if not self._upgraded and self.peer.session is not None:
            self._upgraded = True
            self.peer.legacy = self.peer.settling = False
        return self._upgraded


class LegacyPeers:
    """All legacy peers by host address. `next_at` is when something is due."""

    __slots__ = ("_heartbeat_at", "_restored", "_state", "accepted", "by_host")

    def __init__(self, state: State, positions: Mapping[str, ReceivePosition]) -> None:
        """`positions` are those of the previous run, by peer."""
        self._state = state
        self._restored = dict(positions)
        self.accepted = 0
        """Datagrams of configured addresses. Nothing authenticates them."""
        self.by_host: dict[str, LegacyPeer] = {}
        """The configured peers by their host's address."""
        self._heartbeat_at = float("-inf")
        self.apply()

    def apply(self) -> None:
        """Apply the settings' neighbors; peers that stay keep their state."""
        desired = {neighbour.address[0]: neighbour for neighbour in self._state.settings.neighbours if neighbour.legacy}
        for host in list(self.by_host):
            if host not in desired or self.by_host[host].neighbour != desired[host]:
                self._drop(self.by_host.pop(host))
        for host, neighbour in desired.items():
            if host not in self.by_host and neighbour.name is not None:
                peer = self._state.peer_table.get_or_create(neighbour.name, self._state.settings)
                if peer is not None:
                    peer.legacy = True
                    peer.transition(PeerEvent.CONFIGURED)
                    position = self._restored.pop(neighbour.name, None)
                    self.by_host[host] = LegacyPeer(neighbour, peer, self._state.settings, self._state.rng, position)

    def _drop(self, removed: LegacyPeer) -> None:
        """Remove a peer no longer configured; forget it completely if it was never heard and nothing waits for it."""
        peer, state = removed.peer, self._state
        peer.legacy = peer.settling = False
        peer.legacy_meters = None
        heard = peer.session is not None or peer.legacy_path is not None
        if not heard and not peer.open_sender().pending and not state.outboxes.holds(peer.name):
            state.ready.pop(peer, None)
            del state.peer_table.peers[peer.name]

    def positions(self) -> dict[str, ReceivePosition]:
        """The receive position of each peer, for the next run of this node."""
        known = ((legacy.peer.name, legacy.acks.position()) for legacy in self._active())
        return {name: position for name, position in known if position is not None}

    def receive(self, data: bytes | memoryview, link: str, source: Address, now: float) -> None:
        """Process a datagram without our mark: the legacy format from a configured address, or foreign."""
        counters = self._state.event_queue.counters
        legacy = self.by_host.get(source[0])
        if legacy is None or legacy.is_upgraded() or source != legacy.neighbour.address:
            # Legacy programs send from the port they listen on; other ports of that computer are not trusted.
            counters.dropped_unauthenticated += 1
            return
        try:
            datagram = decode_legacy(data)
            self.accepted += 1
            self._on_activity(legacy, link, source, now)
            legacy.received_bytes += len(data) + IP_UDP_BYTES
            match datagram:
                case Host():
                    self._acknowledge(legacy, legacy.acks.heartbeat(now))
                case LegacyAck(sequence, position):
                    legacy.sender.acknowledge(sequence, position, now)
                    report_ended(self._state, legacy.peer, now)
                case LegacyPayload():
                    self._receive_fragment(legacy, datagram, link, source, now)
        except DecodeError:
            counters.dropped_malformed += 1

    def _on_activity(self, legacy: LegacyPeer, link: str, source: Address, now: float) -> None:
        if now - legacy.last_heard > RESTARTED_AFTER_S:
            legacy.settled_at = now + SETTLE_S
            legacy.peer.settling = True
        legacy.last_heard = now
        if link != legacy.link and legacy.link in self._state.links and now - legacy.link_heard_at < STALE_PATH_S:
            # Its broadcasts may come over several links, but it knows us by the address that we send from.
            link = legacy.link
        else:
            legacy.link, legacy.link_heard_at = link, now
        legacy.address = source
        legacy.sender.on_activity()
        peer = legacy.peer
        peer.legacy_path = (source, link, now)
        if not peer.online:
            peer.transition(PeerEvent.HEARD)
            peer.online_since = now
            self._state.event_queue.emit(PeerOnline(peer.name, source, link))

    def _receive_fragment(
        self, legacy: LegacyPeer, fragment: LegacyPayload, link: str, source: Address, now: float
    ) -> None:
        reassembly = legacy.unicasts if fragment.wants_ack else legacy.broadcasts
        message: PriorityMeshData | None = None
        keep = True
        too_large = reassembly.over_limit
        try:
            keep, message = reassembly.add(fragment, now)
        finally:
            self._state.event_queue.counters.dropped_over_limit += reassembly.over_limit - too_large
            if keep and fragment.wants_ack:
                more = legacy.acks.on_fragment(fragment, now)
                self._acknowledge(legacy, [LegacyAck(fragment.sequence, fragment.position), *more])
        if message is not None:
            if not self._topic_allowed(legacy, message):
                self._state.event_queue.counters.dropped_over_limit += 1
                return
            self._state.event_queue.counters.messages_received += 1
            priority = min(message.priority, PRIORITY_LEVELS - 1)
            self._state.event_queue.emit(
                MessageReceived(
                    legacy.peer.name,
                    message.topic,
                    message.type_name,
                    message.data,
                    priority,
                    not fragment.wants_ack,
                )
            )

    def _topic_allowed(self, legacy: LegacyPeer, message: PriorityMeshData) -> bool:
        """Whether a message's topic and type are valid ROS names, and its topics not too many."""
        if not is_ros_name(message.topic) or not is_ros_type(message.type_name):
            return False
        if message.topic not in legacy.topics:
            if len(legacy.topics) >= MAX_TOPICS:
                return False
            legacy.topics.add(message.topic)
        return True

    def _acknowledge(self, legacy: LegacyPeer, acks: list[LegacyAck]) -> None:
        for ack in acks:
            self._state.outgoing.append(Datagram(legacy.link, legacy.address, encode_legacy(ack), True))

    def encapsulate_broadcasts(self, out: list[Datagram]) -> list[Datagram]:
        """Encapsulate broadcasts so that legacy programs ignore them."""
        to_all = {link.broadcast for link in self._state.links.values()} | {None}
        return [
            datagram._replace(data=encapsulate(datagram.data)) if datagram.destination in to_all else datagram
            for datagram in out
        ]

    def send(self, now: float, out: list[Datagram]) -> None:
        """Send the fragments that may be sent now."""
        for legacy in self._active():
            if legacy.link and (legacy.peer.open_sender().pending or legacy.sender.timer() is not None):
                self._follow_own_address(legacy, now)
                legacy.sender.send(legacy.link, legacy.address, now, out)
                report_ended(self._state, legacy.peer, now)

    def _follow_own_address(self, legacy: LegacyPeer, now: float) -> None:
        """Restart what is under way once our address is another one: the legacy program takes us for another robot, and
        never completes a message of which it has some fragments from the old address."""
        link = self._state.links.get(legacy.link)
        if link is None:
            return
        if legacy.own_host not in (None, link.address[0]):
            legacy.peer.open_sender().restart(now)
        legacy.own_host = link.address[0]

    def next_at(self) -> float:
        """When `handle_timer` is due."""
        if not self.by_host:
            return float("inf")
        at = self._heartbeat_at
        for legacy in self._active():
            due = legacy.sender.timer()
            if legacy.link:
                at = min(at, legacy.acks.next_at(), at if due is None else due)
        return at

    def handle_timer(self, now: float) -> None:
        """Send acknowledgments that are due; once a second heartbeats, offline checks and purges."""
        for legacy in self._active():
            if legacy.link:
                self._acknowledge(legacy, legacy.acks.due(now))
        if not self.by_host or now < self._heartbeat_at:
            return
        # This process was suspended for that long: the silence was ours.
        suspended_s = now - self._heartbeat_at if self._heartbeat_at != float("-inf") else 0.0
        self._heartbeat_at = now + LEGACY_HEARTBEAT_S
        state = self._state
        rates = state.settings.rates
        for legacy in self._active():
            peer = legacy.peer
            if suspended_s > SUSPENDED_S:
                legacy.last_heard = min(now, legacy.last_heard + suspended_s)
            silent_s = now - legacy.last_heard
            if peer.online and silent_s > rates.offline_s:
                peer.transition(PeerEvent.SILENT)
                peer.online_since = None
                state.event_queue.emit(PeerOffline(peer.name, left=False))
                store_in_outbox(state, peer, now)
            if peer.state is PeerState.OFFLINE and silent_s > rates.peer_lost_s:
                peer.transition(PeerEvent.GIVEN_UP)
                peer.open_sender().finish_all(Outcome.PEER_LOST)
                report_ended(state, peer, now)
            legacy.unicasts.purge(now)
            legacy.broadcasts.purge(now)
            if peer.online and legacy.settled_at is not None and now >= legacy.settled_at:
                legacy.settled_at = None
                peer.settling = False
            if peer.online and legacy.settled_at is None and state.outboxes.holds(peer.name):
                release_outbox(state, peer, now)
            legacy.meters.sent.feed(peer.open_sender().sent_bytes, now)
            legacy.meters.delivered.feed(peer.open_sender().delivered_bytes, now)
            legacy.meters.received.feed(legacy.received_bytes, now)
            for link in self._links(legacy):
                host = encode_legacy(Host(state.settings.name, link.address[0]))
                state.outgoing.append(Datagram(link.name, legacy.neighbour.address, host, True))

    def _active(self) -> list[LegacyPeer]:
        return [legacy for legacy in self.by_host.values() if not legacy.is_upgraded()]

    def _links(self, legacy: LegacyPeer) -> list[LinkInfo]:
        # The legacy format has room for an IPv4 address only.
        links = [link for link in self._state.own_links() if ":" not in link.address[0]]
        named = [link for link in links if link.name == (legacy.neighbour.link or legacy.link)]
        return named or links
