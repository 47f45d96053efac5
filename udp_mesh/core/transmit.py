"""Datagrams out and timers: what is sent now, most urgent first, and when the next timer is due.

One call of `collect` returns datagrams already built (heartbeats), then acknowledgments and control frames, redundant
copies, and finally level by level broadcasts and the peers in turn. A peer with nothing more to send leaves
`State.ready` until an acknowledgment, a timer or a new message returns it.
"""

from heapq import heappop

from udp_mesh.core.frame_handlers import inflate_step
from udp_mesh.core.interfaces import Datagram
from udp_mesh.core.path_mtu import compare_sizes
from udp_mesh.core.peer_lifecycle import maintain
from udp_mesh.core.peers.heartbeat import heartbeat_datagrams
from udp_mesh.core.peers.introduction import introduction
from udp_mesh.core.peers.session import Peer, Session
from udp_mesh.core.publish import broadcast_room, compress_step, expire_held, report_ended
from udp_mesh.core.sender.message import OutgoingMessage
from udp_mesh.core.sender.packetizer import send_copies, send_level
from udp_mesh.core.sender.path import IP_UDP_BYTES
from udp_mesh.core.sender.sender import Sender
from udp_mesh.core.settings import RELAY_LINK, Address, LinkKind
from udp_mesh.core.state import MAINTENANCE_INTERVAL_S, State
from udp_mesh.wire.codec import encode
from udp_mesh.wire.frames import Cancel, Delivered, Ping
from udp_mesh.wire.limits import MAX_FRAMES_PER_DATAGRAM, MAX_IDS

BATCH_BYTES = 65_536
"""Approximate maximum of one call: one system call with segmentation offload."""

INTRODUCTION_INTERVAL_S = 0.25
"""Between two introductions to a peer that has not answered one."""

_INFINITY = float("inf")
_ALWAYS = float("-inf")


def collect(state: State, now: float, max_bytes: int | None) -> list[Datagram]:
    """See `Endpoint.datagrams_to_send`."""
    out: list[Datagram] = []
    room = BATCH_BYTES if max_bytes is None else min(max_bytes, BATCH_BYTES)
    if room <= 0:
        return out
    if state.outgoing:
        out.extend(state.outgoing)
        state.outgoing.clear()
    if state.control_ready:
        sessions = list(state.control_ready)
        state.control_ready.clear()
        for session in sessions:
            _send_control(state, session, now, out)
    if state.ready or state.broadcasts.waiting:
        _send_levels(state, now, out, room)
    if state.versions.blocked:
        for name, message in state.versions.unblock():
            _restore(state, name, message)
    return out


def flush_packed(state: State, now: float) -> None:
    """Send what waits to share a datagram."""
    if state.closed:
        return
    for peer in state.peer_table.peers.values():
        if peer.sender is not None and peer.sender.scheduler.waiting:
            peer.sender.packing.sent_at = _ALWAYS
            state.ready[peer] = None
    state.outgoing.extend(collect(state, now, None))


def count_sent(state: State, out: list[Datagram]) -> None:
    """Count the datagrams being sent, in whatever format."""
    counters = state.event_queue.counters
    counters.datagrams_sent += len(out)
    counters.bytes_sent += sum([len(datagram[2]) for datagram in out]) + IP_UDP_BYTES * len(out)


def _restore(state: State, name: str, message: OutgoingMessage) -> None:
    """Queue a message again that was parked to be encoded."""
    peer = state.peer_table.peers.get(name)
    if peer is not None and peer.sender is not None and message in peer.sender.pending:
        peer.sender.scheduler.restore(message)
        state.ready[peer] = None


def _send_control(state: State, session: Session, now: float, out: list[Datagram]) -> None:
    """Send a session's acknowledgment and control frames in as few datagrams as possible."""
    path = session.path
    peer = session.peer
    if not path.link or peer is None or peer.session is not session:
        # The packet numbers of an earlier boot are not those that the sender keeps account of.
        return
    # Acknowledgments from the middle of a batch among them: after a later one their packets would count as lost.
    frames = list(session.pending_control)
    session.pending_control.clear()
    if session.receiver.acks.pending or session.receiver.acks.send_now:
        state.late_acknowledgements += session.receiver.acks.is_late
        waiting = state.priority_backoff.local_waiting(state.waiting_senders(), now)
        acks = session.build_acks(now, waiting[:1])
        frames.extend(acks)
        state.event_queue.counters.acknowledgements_sent += len(acks)
    confirmed = session.receiver.confirmed
    while confirmed:
        frames.append(Delivered(tuple(confirmed[:MAX_IDS])))
        del confirmed[:MAX_IDS]
    sender = peer.open_sender()
    cancelled = sender.cancelled
    while cancelled:
        frames.append(Cancel(tuple(cancelled[:MAX_IDS])))
        del cancelled[:MAX_IDS]
    if not path.confirmed and frames and not session.knows_us:
        frames.insert(0, introduction(state, session, now))
    while frames:
        count = min(len(frames), MAX_FRAMES_PER_DATAGRAM - 1)
        encoded = path.encode(frames[:count], now)
        while count > 1 and len(encoded) > path.room_bytes:
            count = max(1, count * path.room_bytes // len(encoded) - 1)
            encoded = path.encode(frames[:count], now)
        number, data = path.seal(encoded)
        sender.in_flight.add(number, None)
        out.append(Datagram(path.link, path.address, data, True))
        del frames[:count]
    state.arm(peer)


def _send_levels(state: State, now: float, out: list[Datagram], room: int) -> None:
    allowed = state.priority_backoff.allowed_levels(now)
    broadcasts = state.broadcasts
    peers: list[tuple[Peer, Sender]] = []
    mask = broadcasts.waiting
    for peer in list(state.ready):
        sender = peer.open_sender()
        session = peer.session
        if session is None or not session.path.link:
            del state.ready[peer]
            continue
        if sender.cancelled and not sender.scheduler.waiting:
            state.schedule_control(session)
        if sender.copies.next_at <= now:
            send_copies(sender, session.path, now, out)
        if sender.scheduler.waiting:
            if (
                not session.path.confirmed
                and not session.knows_us
                and now >= session.introduced_at + INTRODUCTION_INTERVAL_S
            ):
                session.introduced_at = now
                number, data = session.path.seal(encode([introduction(state, session, now)]))
                sender.in_flight.add(number, None)
                out.append(Datagram(session.path.link, session.path.address, data, True))
            peers.append((peer, sender))
            sender.wake_at = _INFINITY
            sender.packing.waiting = 0
            mask |= sender.scheduler.waiting
        else:
            del state.ready[peer]
            sender.app_limited = True
            state.arm(peer)
    held = mask & ~allowed
    held_until = state.priority_backoff.held_until(now) if held else None
    broadcasts.held, broadcasts.held_until = held, held_until or now
    mask &= allowed
    while mask and room > 0:
        bit = mask & -mask
        mask ^= bit
        priority = bit.bit_length() - 1
        if broadcasts.waiting & bit:
            before = len(out)
            _send_broadcasts(state, priority, now, out)
            room -= sum(len(datagram.data) for datagram in out[before:])
            _set_relayed_aside(state, priority, out, before)
        for peer, sender in peers:
            if not sender.scheduler.waiting & bit:
                continue
            session = peer.session
            assert session is not None
            before = len(out)
            used = send_level(sender, session.path, priority, now, out, room, state.rate_limits)
            _set_relayed_aside(state, priority, out, before)
            if used:
                sender.served |= bit
                sender.levels.record_sent(priority, used, now)
            room -= used
            if room <= 0:
                # A peer that used up the room is served last next time.
                state.ready[peer] = state.ready.pop(peer)
                break
    for peer, sender in peers:
        if sender.served:
            sender.levels.record_served(sender.served, sender.scheduler.waiting, now)
            sender.served = 0
        if sender.ended:
            report_ended(state, peer, now)
        if room > 0:
            state.ready.pop(peer, None)
            sender.app_limited = not sender.scheduler.waiting & ~sender.packing.waiting
        if held_until is not None and held & sender.scheduler.waiting:
            peer.record_held(held & sender.scheduler.waiting, now, held_until)
            sender.wake_at = min(sender.wake_at, held_until)
        state.arm(peer)


def _set_relayed_aside(state: State, priority: int, out: list[Datagram], start: int) -> None:
    """Move the datagrams for nodes behind relays, whose next hop is chosen later, with their priority."""
    if RELAY_LINK in state.links and len(out) > start:
        state.relayed += [(priority, datagram) for datagram in out[start:] if datagram.link == RELAY_LINK]
        out[start:] = [datagram for datagram in out[start:] if datagram.link != RELAY_LINK]


def _send_broadcasts(state: State, priority: int, now: float, out: list[Datagram]) -> None:
    rates = state.settings.rates
    urgent = priority <= rates.urgent_priority
    senders = [peer.sender for peer in state.peer_table.online()] if urgent else []
    twice = any(sender is not None and sender.loss.send_twice for sender in senders)
    paths: list[tuple[str, Address | None]] = [
        (link.name, link.broadcast) for link in state.links.values() if link.kind is LinkKind.BROADCAST
    ]
    for peer in state.peer_table.online():
        session = peer.session
        if session is None:
            continue
        link = state.links.get(session.path.link)
        if link is not None and link.kind is LinkKind.NEIGHBOURS:
            paths.append((link.name, session.path.address))
    state.broadcasts.send_level(
        priority,
        state.broadcast_channel,
        paths,
        now,
        out,
        packets_per_s=None if urgent else rates.broadcast_packets_per_s,
        copy_after_s=rates.twice_gap_s if twice else None,
        repairable_limit_bytes=state.settings.limits.repair_bytes,
        max_timestamped_bytes=_max_timestamped_bytes(state),
    )


def _max_timestamped_bytes(state: State) -> int:
    """Size of the largest broadcast that may carry a timestamp; 0 if some peer does not accept timestamps."""
    sessions = [peer.session for peer in state.peer_table.online() if peer.session is not None]
    return broadcast_room(state, sessions) if all(session.timed for session in sessions) else 0


def has_datagrams(state: State) -> bool:
    """See `Endpoint.has_datagrams`."""
    return bool(state.control_ready or state.ready or state.outgoing or state.broadcasts.waiting)


def is_quiet(state: State) -> bool:
    """See `Endpoint.is_quiet`."""
    return not (has_datagrams(state) or state.event_queue.has_events)


def next_timer(state: State) -> float | None:
    """See `Endpoint.next_timer`."""
    at = min(state.maintenance_at, state.heartbeats.next_at, state.broadcasts.next_at(), state.next_peer_at())
    for bucket in state.rate_limits.values():
        if bucket.has_parked:
            at = min(at, bucket.ready_at())
    has_steps = state.compression_queue.topics or state.inflating or (state.versions.jobs and state.versions.has_work)
    if has_steps and not state.closed:
        # Due at once, repeatedly; other timers are handled in between.
        return _ALWAYS
    return None if at == _INFINITY or state.closed else at


def handle_timer(state: State, now: float) -> None:
    """See `Endpoint.handle_timer`."""
    if state.closed:
        return
    due_peers: list[Peer] = []
    while state.next_peer_at() <= now:
        _, _, peer = heappop(state.timers)
        peer.timer_at = peer.due_at = _INFINITY
        due_peers.append(peer)
    for peer in due_peers:
        sender = peer.open_sender()
        sender.handle_timer(now)
        report_ended(state, peer, now)
        session = peer.session
        if session is not None:
            due = session.receiver.acks.due_at
            if due is not None and due <= now:
                session.receiver.acks.send_now = True
                session.receiver.acks.due_at = None
                state.schedule_control(session)
            if sender.consume_small_probe(now):
                session.queue_control(Ping(state.rng.getrandbits(64)))
                state.schedule_control(session)
            if sender.pmtu.comparisons.next_at <= now:
                compare_sizes(state, peer, sender, session, now)
        state.ready[peer] = None
        state.arm(peer)
    if state.heartbeats.next_at <= now:
        _send_heartbeats(state, now)
    for bucket in state.rate_limits.values():
        if bucket.has_parked and (in_turn := bucket.unpark(now)):
            peers = {peer.sender: peer for peer in state.peer_table.peers.values()}
            for sender in in_turn:
                if (waiting := peers.get(sender)) is not None:
                    # to the end, so that the order is that of the turns
                    state.ready.pop(waiting, None)
                    state.ready[waiting] = None
    broadcasts: list[Datagram] = []
    state.broadcasts.send_copies(now, broadcasts)
    state.outgoing.extend(broadcasts)
    if state.compression_queue.topics:
        compress_step(state, now)
    if state.inflating:
        inflate_step(state, now)
    if state.versions.jobs and state.versions.has_work and (prepared := state.versions.step()) is not None:
        _restore(state, *prepared)
    if state.maintenance_at <= now:
        state.maintenance_at = now + MAINTENANCE_INTERVAL_S
        maintain(state, now)
        expire_held(state, now)
        _send_nacks(state, now)


def _send_heartbeats(state: State, now: float) -> None:
    sessions = list(state.peer_table.sessions.values())
    waiting = state.priority_backoff.local_waiting(state.waiting_senders(), now)
    sent = state.sent.per_s(now)
    beat = state.heartbeats.build(state.settings, sessions, waiting, state.broadcasts.next_number, sent, now)
    datagrams = heartbeat_datagrams(beat, state.broadcast_channel, state.own_links(), state.settings.neighbours)
    if state.relay_targets and RELAY_LINK in state.links:
        targets = tuple(state.relay_targets.values())
        datagrams += heartbeat_datagrams(beat, state.broadcast_channel, [state.links[RELAY_LINK]], targets)
    state.event_queue.counters.heartbeats_sent += len(datagrams)
    state.outgoing.extend(datagrams)


def _send_nacks(state: State, now: float) -> None:
    repairs_due = list(state.repairs_due)
    state.repairs_due.clear()
    for boot_id in repairs_due:
        repairs = state.repairs.get(boot_id)
        session = state.peer_table.sessions.get(boot_id)
        if repairs is None or session is None:
            continue
        nacks = repairs.due_nacks(now) if repairs.next_at <= now else []
        state.schedule_repair(boot_id, repairs)
        if not nacks:
            continue
        state.event_queue.counters.repairs_asked += len(nacks)
        for nack in nacks:
            session.queue_control(nack)
        state.schedule_control(session)
