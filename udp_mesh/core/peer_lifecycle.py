"""The life of a peer: heartbeats and authenticated datagrams in -> sessions, events and the outcome of messages out.

1. `on_heartbeat` processes a heartbeat: an unknown boot is remembered and answered; one that lists us is verified, or
   challenged if the heartbeat may be a recording.
2. `on_verified` makes a session the current one of its name: online or restarted. A retired boot that is still heard is
   a name conflict.
3. `on_activity` keeps a peer online and migrates its path to a new address. A peer that does not hear us stays offline.
4. `maintain` takes peers that are silent or do not hear us offline, then declares them lost; their messages move to the
   outbox or end.
"""

from udp_mesh.core.broadcast import NackRepair
from udp_mesh.core.events import (
    Incompatible,
    NameConflict,
    PeerAddressChanged,
    PeerOffline,
    PeerOnline,
    PeerRestarted,
    TopicStarved,
)
from udp_mesh.core.path_mtu import refragment, update_pmtu
from udp_mesh.core.peers.first_contact import challenge_contact, proves_contact
from udp_mesh.core.peers.heartbeat import MISSED_HEARTBEATS
from udp_mesh.core.peers.path_validation import validate_path
from udp_mesh.core.peers.peer_state import PeerEvent, PeerState
from udp_mesh.core.peers.peer_table import VerifyResult
from udp_mesh.core.peers.session import STALE_PATH_S, Challenge, Peer, Session
from udp_mesh.core.peers.session_state import ReceptionEvent
from udp_mesh.core.publish import release_outbox, report_ended, store_in_outbox
from udp_mesh.core.sender.pending import Outcome
from udp_mesh.core.sender.send_state import SendState
from udp_mesh.core.sender.sender import Sender
from udp_mesh.core.settings import Address
from udp_mesh.core.state import MAINTENANCE_INTERVAL_S, SUSPENDED_S, State
from udp_mesh.wire.frames import Heartbeat
from udp_mesh.wire.header import VERSION
from udp_mesh.wire.limits import HEARD_TAG_BYTES

IDLE_PEERS_PER_ROUND = 64
"""Peers without traffic checked per round: each of 1,000 is checked every 8 s, and a round stays short."""

REPORT_INTERVAL_S = 60.0
"""Minimum time between two reports of the same conflict, mismatch or incompatibility."""


def on_heartbeat(
    state: State, session: Session, beat: Heartbeat, link: str, source: Address, now: float, *, to_all: bool
) -> None:
    """Process an authentic heartbeat (broadcast or unicast), which may be replayed until the session is verified."""
    session.update_from(beat, now)
    state.channel_share.on_send_rate(
        session.boot_id, beat.send_rate, now, valid_s=MISSED_HEARTBEATS * session.interval_s
    )
    session.last_heard = now
    if not beat.min_version <= VERSION <= beat.max_version:
        if now - state.incompatible_reported.get(session.boot_id, float("-inf")) > REPORT_INTERVAL_S:
            state.incompatible_reported[session.boot_id] = now
            if len(state.incompatible_reported) > state.settings.limits.strangers:
                del state.incompatible_reported[next(iter(state.incompatible_reported))]
            state.event_queue.emit(Incompatible(session.name, source, session.versions))
        return
    lists_us = state.boot_id[:HEARD_TAG_BYTES] in beat.heard
    if to_all:
        session.on_heard_list(beat.heard, state.boot_id[:HEARD_TAG_BYTES], now)
    elif lists_us:
        session.on_reception(ReceptionEvent.CONFIRMED, now)
    if not session.verified:
        if (link, source) == (session.path.link, session.path.address):
            session.path.heard_at = now
        else:
            migrate_path(state, session, link, source, now)
        if lists_us:
            if proves_contact(state, session, beat, now):
                on_verified(state, session, now)
            else:
                challenge_contact(state, session, link, source, now)
    else:
        on_activity(state, session, link, source, now)
        if session.name == state.settings.name:
            _own_name(state, session, now)
    if not (session.verified and session.knows_us):
        # It does not hear us, or we cannot know that yet.
        state.heartbeats.reply_to(session, len(state.peer_table.sessions), now)
    if session.verified and session.peer is not None:
        repairs = state.repairs.get(session.boot_id)
        if repairs is None:
            repairs = state.repairs[session.boot_id] = NackRepair(state.rng)
            for channel in session.broadcast_channels:
                channel.window.raise_floor(beat.broadcast_number)
        repairs.on_counter(beat.broadcast_messages, now, session.receiver.broadcasts.finished)
        state.schedule_repair(session.boot_id, repairs)
        if beat.waiting:
            state.priority_backoff.on_waiting(beat.waiting, now)


def on_verified(state: State, session: Session, now: float) -> None:
    """The session has proved that it hears our current boot."""
    result, peer = state.peer_table.verify(session, state.settings)
    if result is VerifyResult.OWN_NAME:
        _own_name(state, session, now)
        return
    if peer is None:
        state.event_queue.counters.dropped_over_limit += 1
        return
    if result is VerifyResult.RETIRED:
        # It becomes current again when it is heard and the later boot is gone (`on_activity`).
        return
    session.freshness.confirm(now)
    _replace(state, peer, session, now)
    if result is VerifyResult.RESTARTED and peer.online:
        state.event_queue.emit(PeerRestarted(peer.name))
        peer.online_since = now
    set_online(state, peer, session, now)
    state.arm(peer)


def _own_name(state: State, session: Session, now: float) -> None:
    """Report that another node uses our name, at a limited rate however many boots are invented."""
    if now - state.own_name_reported_at < REPORT_INTERVAL_S:
        return
    state.own_name_reported_at = now
    own = next((link.address for link in state.own_links()), ("", state.settings.port))
    state.event_queue.emit(NameConflict(session.name, own, session.path.address, own=True))


def _replace(state: State, peer: Peer, session: Session, now: float) -> None:
    """Make the session the current one of its name; pending messages restart with it."""
    old = peer.session
    state.peer_table.replace(peer, session)
    if old is not None:
        state.repairs.pop(old.boot_id, None)
        state.control_ready.pop(old, None)
        if peer.sender is not None:
            old.next_wire_id = peer.sender.next_wire_id
    if peer.sender is not None:
        peer.sender.restart(now)
        # A boot that becomes current again remembers what it had: its numbers continue.
        peer.sender.in_flight.restart(session.path.channel.next_number)
        peer.sender.next_wire_id = session.next_wire_id
        state.ready[peer] = None
    state.heartbeats.reply_to(session, len(state.peer_table.sessions), now)


def set_online(state: State, peer: Peer, session: Session, now: float) -> None:
    """The peer is online (again)."""
    if peer.online:
        return
    peer.transition(PeerEvent.HEARD)
    peer.online_since = now
    state.event_queue.emit(PeerOnline(peer.name, session.path.address, session.path.link))
    release_outbox(state, peer, now)


def on_activity(state: State, session: Session, link: str, source: Address, now: float) -> None:
    """An authentic datagram came from a verified session."""
    session.last_heard = now
    path = session.path
    if source == path.address and link == path.link:
        path.heard_at = now
    else:
        migrate_path(state, session, link, source, now)
    peer = session.peer
    if peer is None or peer.session is not session:
        if peer is None or peer.online:
            report_name_conflict(state, session, source, now)
            return
        # Of two nodes with one name the later one is gone: the name means this one again, if the datagram is fresh.
        if not session.is_fresh(now):
            validate_path(state, session, link, source, now)
            return
        _replace(state, peer, session, now)
    if session.one_way_since is not None:
        return
    if not peer.online:
        if not session.is_fresh(now):
            # It may be a replayed datagram that never arrived; the answer to a challenge cannot be one.
            validate_path(state, session, link, source, now)
            return
        set_online(state, peer, session, now)
    if peer.sender is not None and peer.sender.state is SendState.UNRESPONSIVE:
        peer.sender.on_activity(now)
        state.ready[peer] = None


def report_name_conflict(state: State, session: Session, source: Address, now: float) -> None:
    """A boot that was replaced by a later one is still heard: two nodes use one name."""
    peer = session.peer or state.peer_table.peers.get(session.name)
    if peer is None or peer.session is None:
        return
    if peer.online_since is not None and now - peer.online_since < STALE_PATH_S:
        # The last packets of a boot may arrive after the first ones of the next.
        return
    session.name_conflict = True
    if now - peer.conflict_reported_at < REPORT_INTERVAL_S:
        return
    peer.conflict_reported_at = now
    state.event_queue.emit(NameConflict(session.name, source, peer.session.path.address, own=False))


def migrate_path(state: State, session: Session, link: str, source: Address, now: float) -> None:
    """The session was heard at another address: use it if there is none yet, or if the current one has gone quiet and
    the peer answers there.

    A peer of an earlier version answers to where it was heard before, perhaps over a link that is gone. If nothing at
    all comes from its old address, its path migrates without validation.
    """
    if link not in state.links:
        return
    path = session.path
    sender = session.peer.sender if session.peer is not None else None
    timing_out = sender is not None and sender.state is not SendState.ACTIVE
    first = not path.link
    better = state.is_better_path(session, link)
    quiet = now - path.heard_at >= STALE_PATH_S or path.link not in state.links
    if not (first or quiet or timing_out or better):
        return
    peer = session.peer
    if not first and session.verified and peer is not None and (session.timed or not quiet or not peer.online):
        validate_path(state, session, link, source, now, better=better)
        return
    _switch_path(state, session, link, source, now)


def on_path_validated(state: State, session: Session, challenge: Challenge, now: float) -> None:
    """The peer answered a challenge: it is alive and at that address."""
    session.freshness.confirm(now)
    path = session.path
    if challenge.in_use:
        # The current path works, so datagrams from elsewhere were no migration. If it was left meanwhile, return to it.
        session.challenges.clear()
    if (path.link, path.address) != (challenge.link, challenge.address):
        _switch_path(state, session, challenge.link, challenge.address, now)
    if not session.verified:
        on_verified(state, session, now)
        if session.peer is None:
            return
    on_activity(state, session, challenge.link, challenge.address, now)


def _switch_path(state: State, session: Session, link: str, source: Address, now: float) -> None:
    """Send datagrams to that address from now on."""
    info = state.links.get(link)
    if info is None:
        return
    path = session.path
    sender = session.peer.sender if session.peer is not None else None
    first = not path.link
    old = path.address
    before = path.fragment_bytes
    path.switch_to(link, source, info.mtu, state.settings.fragment_bytes)
    path.heard_at = now
    if not first and session.verified and session.peer is not None:
        state.event_queue.emit(PeerAddressChanged(session.name, old, source, link))
    if sender is not None and path.fragment_bytes < before:
        refragment(sender, path, include_sent=False)
    if sender is not None and session.peer is not None and (first or path.fragment_bytes < before):
        # A boot that was first heard over a link that is gone had no path: what waits for it has no timer. Nor has a
        # message that was restarted while its topic's rate limit held everything else.
        state.ready[session.peer] = None


def on_bye(state: State, session: Session, now: float) -> None:
    """The peer said goodbye."""
    peer = session.peer
    if peer is None or peer.session is not session or not peer.online:
        return
    set_offline(state, peer, now, left=True)


def set_offline(state: State, peer: Peer, now: float, *, left: bool) -> None:
    """The peer is unreachable: messages with an outbox move there; the rest waits for `peer_lost_s`."""
    peer.transition(PeerEvent.SILENT)
    peer.online_since = None
    state.event_queue.emit(PeerOffline(peer.name, left))
    if (
        peer.sender is not None
        and peer.sender.state is not SendState.UNRESPONSIVE
        and peer.sender.in_flight.outstanding
    ):
        peer.sender.become_unresponsive(now)
    store_in_outbox(state, peer, now)


def maintain(state: State, now: float) -> None:
    """One maintenance round: all peers with traffic, and a limited number of the others."""
    suspended_s = now - state.maintained_at - MAINTENANCE_INTERVAL_S
    state.maintained_at = now
    if suspended_s > SUSPENDED_S:
        _discount_suspension(state, suspended_s, now)
    mismatch = state.key_mismatches.flush(now)
    if mismatch is not None:
        state.event_queue.emit(mismatch)
    state.sent.feed(state.event_queue.counters.bytes_sent, now)
    queue_share = state.channel_share.queue_share(state.sent.per_s(now), now)
    peers = list(state.peer_table.peers.values())
    start = state.maintain_from if state.maintain_from < len(peers) else 0
    state.maintain_from = start + IDLE_PEERS_PER_ROUND
    senders = [(peer, peer.sender) for peer in peers if peer.sender is not None]
    for peer, sender in senders:
        sender.congestion.queue_share = queue_share
        _maintain_peer(state, peer, now)
    for peer in peers[start : state.maintain_from]:
        if peer.sender is None:
            _maintain_peer(state, peer, now)
    for name in state.outboxes.peers():
        peer_with_outbox = state.peer_table.peers.get(name)
        if peer_with_outbox is not None and peer_with_outbox.online and not peer_with_outbox.settling:
            release_outbox(state, peer_with_outbox, now)
    for session in state.peer_table.not_current():
        session.age_windows(now)
        if session.name_conflict and session.peer is not None:
            # It may become current again as long as its name is remembered.
            session.receiver.unicasts.purge(now)
            session.receiver.broadcasts.purge(now)
        elif now - session.last_heard > state.settings.rates.offline_s:
            state.peer_table.forget(session)
            state.repairs.pop(session.boot_id, None)
            state.incompatible_reported.pop(session.boot_id, None)


def _discount_suspension(state: State, suspended_s: float, now: float) -> None:
    """This process was suspended for that long (stopped, or its machine was): the silence was ours."""
    for session in state.peer_table.sessions.values():
        session.last_heard = min(now, session.last_heard + suspended_s)
        if session.one_way_since is not None:
            session.one_way_since = min(now, session.one_way_since + suspended_s)


def _maintain_peer(state: State, peer: Peer, now: float) -> None:
    session = peer.session
    if session is None:
        return
    rates = state.settings.rates
    session.age_windows(now)
    silent_s = now - session.last_heard
    one_way_s = now - session.one_way_since if session.one_way_since is not None else 0.0
    offline_after_s = max(rates.offline_s, MISSED_HEARTBEATS * session.interval_s)
    if peer.online and max(silent_s, one_way_s) > offline_after_s:
        set_offline(state, peer, now, left=False)
    if peer.state is PeerState.OFFLINE and max(silent_s, one_way_s) > rates.peer_lost_s:
        peer.transition(PeerEvent.GIVEN_UP)
        if peer.sender is not None:
            peer.sender.finish_all(Outcome.PEER_LOST)
            report_ended(state, peer, now)
    if session.receiver.fragments:
        session.receiver.unicasts.purge(now)
        session.receiver.broadcasts.purge(now)
    if session.received_bytes:
        session.meters.received.feed(session.received_bytes, now)
    sender = peer.sender
    if sender is not None:
        if peer.online and sender.unconfirmed and sender.request_confirmations(now):
            state.ready[peer] = None
        _report_starved(state, peer.name, sender, now)
        update_pmtu(state, peer, sender, session, now)
        session.meters.sent.feed(sender.sent_bytes, now)
        session.meters.delivered.feed(sender.delivered_bytes, now)
        sender.levels.measure(now)
        if peer.trend is not None:
            congestion = sender.congestion
            capacity = congestion.capacity_packets_per_s() if congestion.is_capacity_current(now) else None
            peer.trend.feed(capacity, sender.rtt.smoothed_rtt, sender.delivered_packets, now)


def _report_starved(state: State, name: str, sender: Sender, now: float) -> None:
    for level in sender.levels:
        since = level.starved_since
        if since is None or level.starved_reported or now - since < state.settings.rates.starved_s:
            continue
        oldest = level.oldest()
        if oldest is not None:
            level.starved_reported = True
            state.event_queue.emit(TopicStarved(name, oldest.accepted.channel.name, now - since))
