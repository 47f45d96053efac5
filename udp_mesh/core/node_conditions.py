"""A snapshot of a node for the autonomy, the status page and the metrics: its state -> `Conditions`."""

from collections.abc import Iterator, Mapping
from dataclasses import replace

from udp_mesh.core.conditions import Conditions, PeerConditions, QueueConditions, UnverifiedNode
from udp_mesh.core.meter import Meter
from udp_mesh.core.peers.heartbeat import MISSED_HEARTBEATS
from udp_mesh.core.peers.session import Peer, Session
from udp_mesh.core.sender.send_state import SendState
from udp_mesh.core.sender.sender import Sender
from udp_mesh.core.settings import RELAY_LINK, Address
from udp_mesh.core.state import State

REPORTED_RATE_VALID_S = 2.0
"""A rate reported in an acknowledgement is valid for the second it averages, and one more."""

UNVERIFIED_AFTER_S = 3.0
"""A node heard for this long without hearing us is listed as unverified; discovery takes a fraction of that."""


def node_conditions(state: State, now: float, via: Mapping[str, tuple[str, ...]]) -> Conditions:
    """See `Endpoint.conditions`. `via`: the relays on the way to peers that are reached through some."""
    idle = Sender(state.settings)
    peers = tuple(
        _peer_conditions(state, peer, peer.sender or idle, via.get(peer.name, ()), now)
        for _, peer in sorted(state.peer_table.peers.items())
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


def _peer_conditions(state: State, peer: Peer, sender: Sender, via: tuple[str, ...], now: float) -> PeerConditions:
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
        sender.loss.rate,
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
        via,
        _available_bits_per_s(sender, capacity_bits_per_s, now) if peer.online else None,
        peer.trend.trend if peer.online and peer.trend is not None else None,
        session.path.mtu if session is not None and session.path.link else None,
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


def _available_bits_per_s(sender: Sender, capacity_bits_per_s: float | None, now: float) -> tuple[float, ...] | None:
    """By priority, what remains of the capacity. That counts what arrives, and so does what is subtracted."""
    if capacity_bits_per_s is None:
        return None
    left_bits_per_s = capacity_bits_per_s
    available = []
    for level in sender.levels:
        available.append(float(round(max(0.0, left_bits_per_s))))
        if level.sent is not None:
            left_bits_per_s -= _bits_per_s(level.sent, now) * (1 - sender.loss.rate)
    return tuple(available)


def _reported_bits_per_s(rate: tuple[int, float], for_s: float, now: float) -> float | None:
    """The rate in bits per second that a peer reported, unless the report is too old."""
    bytes_per_s, reported_at = rate
    return 8.0 * bytes_per_s if now - reported_at <= for_s else None


def _bits_per_s(meter: Meter, now: float) -> float:
    return 8 * meter.per_s(now)
