"""Peers come, move, restart, clash and go: heartbeats and proofs in -> sessions, events, and what becomes of messages.

1. `greet` takes a heartbeat: a stranger is remembered and answered; one that lists us is proven.
2. `prove` makes a session its name's session: online, or restarted; a retired run that still speaks is a conflict.
3. `heard` keeps an online peer online and follows it to new addresses; one that does not hear us stays offline.
4. `housekeep` finds the silent and the deaf ones: offline, then lost; their messages go to the outbox or end.
"""

from udp_mesh.core.broadcast import NackRepair
from udp_mesh.core.events import (
    Incompatible,
    NameConflict,
    PathNarrowed,
    PeerAddressChanged,
    PeerOffline,
    PeerOnline,
    PeerRestarted,
    TopicStarved,
)
from udp_mesh.core.peers.heartbeat import MISSED_HEARTBEATS
from udp_mesh.core.peers.path_validation import challenge
from udp_mesh.core.peers.peer_table import Arrival
from udp_mesh.core.peers.session import STALE_PATH_S, Challenge, Peer, Session
from udp_mesh.core.publish import release_outbox, report_ended, shelve
from udp_mesh.core.sender.message import OutgoingMessage
from udp_mesh.core.sender.packetizer import Path, build_mtu_probe, datagram_room
from udp_mesh.core.sender.pending import Outcome
from udp_mesh.core.sender.pmtu import NARROWER_MTUS
from udp_mesh.core.sender.sender import Sender
from udp_mesh.core.settings import Address
from udp_mesh.core.state import ASLEEP_S, HOUSEKEEPING_S, State
from udp_mesh.wire.frames import Heartbeat
from udp_mesh.wire.header import VERSION
from udp_mesh.wire.limits import HEARD_TAG_BYTES

LOOKED_AT_PER_ROUND = 64
"""Peers without traffic looked at per round: of 1,000 each is looked at every 8 s, and a round stays short."""

REPORT_AGAIN_S = 60.0
"""The same conflict, mismatch or incompatibility is reported once in this time."""


def greet(
    state: State, session: Session, beat: Heartbeat, link: str, source: Address, now: float, *, to_all: bool
) -> None:
    """An authentic heartbeat of a session (to all, or to us alone), perhaps a recording until the session is
    proven."""
    session.learn(beat, now)
    state.channel_share.on_send_rate(
        session.boot_id, beat.send_rate, now, valid_s=MISSED_HEARTBEATS * session.interval_s
    )
    session.last_heard = now
    if not beat.min_version <= VERSION <= beat.max_version:
        if now - state.incompatible_reported.get(session.boot_id, float("-inf")) > REPORT_AGAIN_S:
            state.incompatible_reported[session.boot_id] = now
            if len(state.incompatible_reported) > state.settings.limits.strangers:
                del state.incompatible_reported[next(iter(state.incompatible_reported))]
            state.event_queue.emit(Incompatible(session.name, source, session.versions))
        return
    lists_us = state.boot_id[:HEARD_TAG_BYTES] in beat.heard
    if to_all:
        session.take_list(beat.heard, state.boot_id[:HEARD_TAG_BYTES], now)
    elif lists_us:
        session.hears_us()
    if not session.proven:
        if (link, source) == (session.path.link, session.path.address):
            session.path.heard_at = now
        else:
            follow(state, session, link, source, now)
        if lists_us:
            prove(state, session, now)
    else:
        heard(state, session, link, source, now)
        if session.name == state.settings.name:
            _own_name(state, session, now)
    if not (session.proven and session.knows_us):
        # It does not hear us, or we cannot know yet that it does.
        state.heartbeats.answer(session, len(state.peer_table.sessions), now)
    if session.proven and session.peer is not None:
        repairs = state.repairs.get(session.boot_id)
        if repairs is None:
            repairs = state.repairs[session.boot_id] = NackRepair(state.rng)
            for channel in session.broadcast_channels:
                channel.window.raise_floor(beat.broadcast_number)
        repairs.counted(beat.broadcast_messages, now, session.receiver.broadcasts.finished)
        state.ask_by(session.boot_id, repairs)
        if beat.waiting:
            state.priority_backoff.heard(beat.waiting, now)


def prove(state: State, session: Session, now: float) -> None:
    """The session has shown that it hears this run of ours."""
    arrival, peer = state.peer_table.prove(session, state.settings)
    if arrival is Arrival.OWN_NAME:
        _own_name(state, session, now)
        return
    if peer is None:
        state.event_queue.counters.dropped_over_limit += 1
        return
    if arrival is Arrival.RETIRED:
        # Served again when it is heard and the later run is gone (`heard`).
        return
    session.freshness.prove(now)
    _replace(state, peer, session, now)
    if arrival is Arrival.RESTARTED and peer.online:
        state.event_queue.emit(PeerRestarted(peer.name))
        peer.online_since = now
    come_online(state, peer, session, now)
    state.arm(peer)


def _own_name(state: State, session: Session, now: float) -> None:
    """Another node uses our name: told as long as it does, and no more often for all the boots one may invent."""
    if now - state.own_name_reported_at < REPORT_AGAIN_S:
        return
    state.own_name_reported_at = now
    own = next(iter(state.links.values())).address if state.links else ("", state.settings.port)
    state.event_queue.emit(NameConflict(session.name, own, session.path.address, own=True))


def _replace(state: State, peer: Peer, session: Session, now: float) -> None:
    """The session is what the name means from now on; what waits for the name begins anew with it."""
    old = peer.session
    state.peer_table.replace(peer, session)
    if old is not None:
        state.repairs.pop(old.boot_id, None)
        state.owing.pop(old, None)
        if peer.has_sender:
            old.next_wire_id = peer.sender.next_wire_id
    if peer.has_sender:
        peer.sender.restart(now)
        # Of a run that is taken back the numbers go on: it remembers what it had.
        peer.sender.in_flight.restart(session.path.channel.next_number)
        peer.sender.next_wire_id = session.next_wire_id
        state.ready[peer] = None
    state.heartbeats.answer(session, len(state.peer_table.sessions), now)


def come_online(state: State, peer: Peer, session: Session, now: float) -> None:
    """The peer is there (again)."""
    peer.left = False
    peer.lost = False
    if peer.online:
        return
    peer.online = True
    peer.online_since = now
    state.event_queue.emit(PeerOnline(peer.name, session.path.address, session.path.link))
    release_outbox(state, peer, now)


def heard(state: State, session: Session, link: str, source: Address, now: float) -> None:
    """Something authentic came from a proven session."""
    session.last_heard = now
    path = session.path
    if source == path.address and link == path.link:
        path.heard_at = now
    else:
        follow(state, session, link, source, now)
    peer = session.peer
    if peer is None or peer.session is not session:
        if peer is None or peer.online:
            conflict(state, session, source, now)
            return
        # Of two nodes with one name the later one went: its name means this one again, if this is its voice.
        if not session.is_fresh(now):
            challenge(state, session, link, source, now)
            return
        _replace(state, peer, session, now)
    if session.unheard_since is not None:
        return
    if not peer.online:
        if not session.is_fresh(now):
            # It may be a recording that never arrived: an answer to a question cannot be one.
            challenge(state, session, link, source, now)
            return
        come_online(state, peer, session, now)
    if peer.has_sender and peer.sender.unresponsive_since is not None:
        peer.sender.on_activity(now)
        state.ready[peer] = None


def conflict(state: State, session: Session, source: Address, now: float) -> None:
    """A run that was replaced by a later one still speaks: two nodes use one name."""
    peer = session.peer or state.peer_table.peers.get(session.name)
    if peer is None or peer.session is None:
        return
    if peer.online_since is not None and now - peer.online_since < STALE_PATH_S:
        # The last packets of a run that ended may come behind the first ones of the next.
        return
    session.contested = True
    if now - peer.conflict_reported_at < REPORT_AGAIN_S:
        return
    peer.conflict_reported_at = now
    state.event_queue.emit(NameConflict(session.name, source, peer.session.path.address, own=False))


def follow(state: State, session: Session, link: str, source: Address, now: float) -> None:
    """The session was heard at an address: use it if it is the only one, or the one in use has gone quiet, and the peer
    answers there.

    A peer of an earlier version answers to where it was heard before, perhaps over a link that is gone: where nothing
    at all comes from there it is followed without a question.
    """
    if link not in state.links:
        return
    path = session.path
    sender = session.peer.sender if session.peer is not None and session.peer.has_sender else None
    timing_out = sender is not None and (sender.timing_out or sender.unresponsive_since is not None)
    first = not path.link
    quiet = now - path.heard_at >= STALE_PATH_S or path.link not in state.links
    if not first and not quiet and not timing_out:
        return
    peer = session.peer
    if not first and session.proven and peer is not None and (session.timed or not quiet or not peer.online):
        challenge(state, session, link, source, now)
        return
    _move(state, session, link, source, now)


def path_proven(state: State, session: Session, question: Challenge, now: float) -> None:
    """The peer answered a ping of ours from where that went: it is alive, and there."""
    session.freshness.prove(now)
    path = session.path
    if question.in_use:
        # The way in use works: whatever came from elsewhere was no move. If it has been left since, it is gone back to.
        session.challenges.clear()
    if (path.link, path.address) != (question.link, question.address):
        _move(state, session, question.link, question.address, now)
    heard(state, session, question.link, question.address, now)


def _move(state: State, session: Session, link: str, source: Address, now: float) -> None:
    """Datagrams go there from now on."""
    info = state.links.get(link)
    if info is None:
        return
    path = session.path
    sender = session.peer.sender if session.peer is not None and session.peer.has_sender else None
    first = not path.link
    old = path.address
    before = path.fragment_bytes
    path.switch_to(link, source, info.mtu, state.settings.fragment_bytes)
    path.heard_at = now
    if not first and session.proven and session.peer is not None:
        state.event_queue.emit(PeerAddressChanged(session.name, old, source, link))
    if sender is not None and path.fragment_bytes < before:
        _fit(sender, path, all_of_it=False)


def refit(state: State, session: Session, mtu: int) -> None:
    """The link, or the settings, changed under a session's way: what leaves from now on fits both, and what the path
    was found to carry."""
    path = session.path
    sender = session.peer.sender if session.peer is not None and session.peer.has_sender else None
    if sender is not None and sender.pmtu.narrowed_at is not None:
        mtu = min(mtu, path.mtu)
    before = path.mtu
    path.switch_to(path.link, path.address, mtu, state.settings.fragment_bytes)
    if sender is not None and mtu < before:
        _fit(sender, path, all_of_it=False)


def _fit(sender: Sender, path: Path, *, all_of_it: bool) -> None:
    """What was cut into larger fragments than the way carries now begins anew.

    One that has left whole may have arrived whole, and under a new number it would arrive twice: it only does so with
    `all_of_it`, where none of its large pieces get through anyhow. Our own kernel cuts what is too large for our link.
    """
    for message in list(sender.pending):
        if not all_of_it and message.begun and message.next_position >= message.fragments:
            continue
        if message.begun and any(
            not there and _size(message, position) > path.fragment_bytes
            for position, there in enumerate(message.arrived)
        ):
            sender.cancel(message)
            sender.resend_from_start(message)


def _size(message: OutgoingMessage, position: int) -> int:
    start, end = message.span(position)
    return end - start


def _measure_path(state: State, peer: Peer, session: Session, now: float) -> None:
    """Smaller fragments where full ones do not get through; larger ones again where a ping of that size does."""
    sender, path = peer.sender, session.path
    size, info = sender.pmtu, state.links.get(path.link)
    fragment_bytes = state.settings.fragment_bytes
    rooms = {mtu: datagram_room(path.address, mtu, fragment_bytes) for mtu in NARROWER_MTUS}
    narrower = [mtu for mtu, room in rooms.items() if room < path.room_bytes]
    if size.is_black_hole(now) and narrower:
        path.switch_to(path.link, path.address, narrower.pop(0), fragment_bytes)
        size.on_narrowed(now)
        state.event_queue.emit(PathNarrowed(peer.name, path.mtu, path.fragment_bytes))
        _fit(sender, path, all_of_it=True)
        state.ready[peer] = None
    size.large_bytes = rooms[narrower[0]] if narrower else float("inf")
    if size.narrowed_at is None or info is None:
        return
    if size.probe.confirmed_mtu > path.mtu:
        path.switch_to(path.link, path.address, min(size.probe.confirmed_mtu, info.mtu), fragment_bytes)
        size.reset()
    rooms = {mtu: room for mtu, room in rooms.items() if mtu < info.mtu}
    rooms[info.mtu] = datagram_room(path.address, info.mtu, fragment_bytes)
    larger = {room: mtu for mtu, room in rooms.items() if room > path.room_bytes}
    if not larger:
        size.narrowed_at = None
    elif peer.online and path.confirmed and sender.unresponsive_since is None and size.probe.due(now, sender.loss):
        for room, mtu in larger.items():
            token = state.rng.getrandbits(64)
            size.probe.on_probe_sent(token, mtu)
            state.outgoing.append(build_mtu_probe(sender, path, token, room))


def leave(state: State, session: Session, now: float) -> None:
    """The peer said good-bye."""
    peer = session.peer
    if peer is None or peer.session is not session or not peer.online:
        return
    go_offline(state, peer, now, left=True)


def go_offline(state: State, peer: Peer, now: float, *, left: bool) -> None:
    """The peer is out of reach: what its topics' outboxes keep goes there, the rest waits for `peer_lost_s`."""
    peer.online = False
    peer.left = left
    peer.online_since = None
    state.event_queue.emit(PeerOffline(peer.name, left))
    if peer.has_sender and peer.sender.unresponsive_since is None and peer.sender.in_flight.outstanding:
        peer.sender.unresponsive_since = now
        peer.sender.allow_probe(now)
    shelve(state, peer, now)


def housekeep(state: State, now: float) -> None:
    """A round: all peers with traffic, and of the others as many as one round bears."""
    asleep_s = now - state.housekept_at - HOUSEKEEPING_S
    state.housekept_at = now
    if asleep_s > ASLEEP_S:
        _excuse(state, asleep_s, now)
    mismatch = state.key_mismatches.rest(now)
    if mismatch is not None:
        state.event_queue.emit(mismatch)
    state.sent.feed(state.event_queue.counters.bytes_sent, now)
    queue_share = state.channel_share.queue_share(state.sent.per_s(now), now)
    peers = list(state.peer_table.peers.values())
    start = state.look_from if state.look_from < len(peers) else 0
    state.look_from = start + LOOKED_AT_PER_ROUND
    has_sender = [peer for peer in peers if peer.has_sender]
    for peer in has_sender:
        peer.sender.congestion.queue_share = queue_share
        _look_at(state, peer, now)
    for peer in peers[start : state.look_from]:
        if not peer.has_sender:
            _look_at(state, peer, now)
    for name in state.outboxes.peers():
        holding = state.peer_table.peers.get(name)
        if holding is not None and holding.online and not holding.settling:
            release_outbox(state, holding, now)
    for session in state.peer_table.not_current():
        session.age_windows(now)
        if session.contested and session.peer is not None:
            # It may be taken back for as long as its name is remembered.
            session.receiver.unicasts.purge(now)
            session.receiver.broadcasts.purge(now)
        elif now - session.last_heard > state.settings.rates.offline_s:
            state.peer_table.forget(session)
            state.repairs.pop(session.boot_id, None)
            state.incompatible_reported.pop(session.boot_id, None)


def _excuse(state: State, asleep_s: float, now: float) -> None:
    """This process did not run for so long (it was stopped, its machine stood still): silence meanwhile was ours."""
    for session in state.peer_table.sessions.values():
        session.last_heard = min(now, session.last_heard + asleep_s)
        if session.unheard_since is not None:
            session.unheard_since = min(now, session.unheard_since + asleep_s)


def _look_at(state: State, peer: Peer, now: float) -> None:
    session = peer.session
    if session is None:
        return
    rates = state.settings.rates
    session.age_windows(now)
    quiet_s = now - session.last_heard
    deaf_s = now - session.unheard_since if session.unheard_since is not None else 0.0
    patience_s = max(rates.offline_s, MISSED_HEARTBEATS * session.interval_s)
    if peer.online and max(quiet_s, deaf_s) > patience_s:
        go_offline(state, peer, now, left=False)
    if not peer.online and not peer.lost and max(quiet_s, deaf_s) > rates.peer_lost_s:
        peer.lost = True
        if peer.has_sender:
            peer.sender.finish_all(Outcome.PEER_LOST)
            report_ended(state, peer, now)
    if session.receiver.fragments:
        session.receiver.unicasts.purge(now)
        session.receiver.broadcasts.purge(now)
    if session.received_bytes:
        session.meters.received.feed(session.received_bytes, now)
    if peer.has_sender:
        _report_starved(state, peer, now)
        _measure_path(state, peer, session, now)
        session.meters.sent.feed(peer.sender.sent_bytes, now)
        session.meters.delivered.feed(peer.sender.delivered_bytes, now)


def _report_starved(state: State, peer: Peer, now: float) -> None:
    for book in peer.sender.levels:
        since = book.starved_since
        if since is None or book.starved_reported or now - since < state.settings.rates.starved_s:
            continue
        oldest = book.oldest()
        if oldest is not None:
            book.starved_reported = True
            state.event_queue.emit(TopicStarved(peer.name, oldest.accepted.channel.name, now - since))
