"""Datagrams out and timers: what leaves now, most urgent first, and when somebody wants attention next.

One call of `collect`: heartbeats already due, what is owed (acknowledgements and small frames), second copies, then
level by level, casts and peers in turn. A peer from which nothing more can leave drops out of `State.ready` until an
acknowledgement, a timer or a new message brings it back.
"""

from heapq import heappop

from udp_mesh.core.interfaces import Datagram
from udp_mesh.core.peer_lifecycle import housekeep
from udp_mesh.core.peers.heartbeat import OWN_FEATURES, announce
from udp_mesh.core.peers.session import Peer, Session
from udp_mesh.core.publish import broadcast_room, expire_held, pack, report_ended
from udp_mesh.core.receive import unpack
from udp_mesh.core.receiver.datagram_age import clock_ms
from udp_mesh.core.sender.packetizer import IP_UDP_BYTES, leave_copies, leave_level
from udp_mesh.core.settings import Address, LinkKind
from udp_mesh.core.state import HOUSEKEEPING_S, State
from udp_mesh.wire.codec import encode
from udp_mesh.wire.frames import Cancel, Frame, Heartbeat, Ping
from udp_mesh.wire.header import VERSION
from udp_mesh.wire.limits import MAX_FRAMES_PER_DATAGRAM, MAX_IDS

BATCH_BYTES = 65_536
"""What one call returns at most, about: one system call with segmentation offload."""

INTRODUCE_AGAIN_S = 0.25
"""Between two introductions to a peer that has not answered one."""

_INFINITY = float("inf")
_ALWAYS = float("-inf")


def collect(state: State, now: float, max_bytes: int | None) -> list[Datagram]:
    """See `Node.datagrams_to_send`."""
    out: list[Datagram] = []
    room = BATCH_BYTES if max_bytes is None else min(max_bytes, BATCH_BYTES)
    if room <= 0:
        return out
    if state.outgoing:
        out.extend(state.outgoing)
        state.outgoing.clear()
    if state.owing:
        sessions = list(state.owing)
        state.owing.clear()
        for session in sessions:
            _leave_owed(state, session, now, out)
    if state.ready or state.casts.waiting:
        _leave_levels(state, now, out, room)
    return out


def count_sent(state: State, out: list[Datagram]) -> None:
    """Datagrams leave, in whatever format."""
    counters = state.ledger.counters
    counters.datagrams_sent += len(out)
    counters.bytes_sent += sum([len(datagram[2]) for datagram in out]) + IP_UDP_BYTES * len(out)


def _leave_owed(state: State, session: Session, now: float, out: list[Datagram]) -> None:
    """Acknowledgement and small frames of one session, together in as few datagrams as they fit."""
    way = session.way
    peer = session.peer
    if not way.link or peer is None:
        return
    frames: list[Frame] = []
    if session.inbound.acks.pending or session.inbound.acks.now_wanted:
        waiting = state.yielding.waiting_here(state.waiting_outbounds(), now)
        ack = session.take_ack(now, waiting[:1])
        if ack is not None:
            frames.append(ack)
            state.ledger.counters.acknowledgements_sent += 1
    frames.extend(session.owed)
    session.owed.clear()
    cancelled = peer.outbound.cancelled
    while cancelled:
        frames.append(Cancel(tuple(cancelled[:MAX_IDS])))
        del cancelled[:MAX_IDS]
    if not way.confirmed and frames and not session.knows_us:
        frames.insert(0, _introduction(state, session, now))
    while frames:
        count = min(len(frames), MAX_FRAMES_PER_DATAGRAM - 1)
        encoded = way.encode(frames[:count], now)
        while count > 1 and len(encoded) > way.room_bytes:
            count = max(1, count * way.room_bytes // len(encoded) - 1)
            encoded = way.encode(frames[:count], now)
        number, data = way.seal(encoded)
        peer.outbound.flight.add(number, None)
        out.append(Datagram(way.link, way.address, data, True))
        del frames[:count]
    state.arm(peer)


def _introduction(state: State, session: Session, now: float) -> Heartbeat:
    """Who we are, for a peer that may not know this run of ours yet."""
    settings = state.settings
    return Heartbeat(
        settings.name,
        VERSION,
        VERSION,
        int(OWN_FEATURES),
        min(65_535, int(settings.rates.heartbeat_sparse_s * 1000)),
        0,
        0,
        state.to_all.next_number,
        state.casts.next_number,
        (session.heard_tag,),
        (),
        clock_ms(now),
    )


def _leave_levels(state: State, now: float, out: list[Datagram], room: int) -> None:
    allowed = state.yielding.allowed(now)
    casts = state.casts
    peers: list[Peer] = []
    mask = casts.waiting
    for peer in list(state.ready):
        outbound = peer.outbound
        session = peer.session
        if session is None or not session.way.link:
            del state.ready[peer]
            continue
        if outbound.cancelled and not outbound.scheduler.waiting:
            state.owe(session)
        if outbound.copies:
            leave_copies(outbound, session.way, now, out)
        if outbound.scheduler.waiting:
            if not session.way.confirmed and not session.knows_us and now >= session.introduced_at + INTRODUCE_AGAIN_S:
                session.introduced_at = now
                number, data = session.way.seal(encode([_introduction(state, session, now)]))
                outbound.flight.add(number, None)
                out.append(Datagram(session.way.link, session.way.address, data, True))
            peers.append(peer)
            outbound.wake_at = _INFINITY
            mask |= outbound.scheduler.waiting
        else:
            del state.ready[peer]
            outbound.limited = True
            state.arm(peer)
    held = mask & ~allowed
    mask &= allowed
    while mask and room > 0:
        bit = mask & -mask
        mask ^= bit
        priority = bit.bit_length() - 1
        if casts.waiting & bit:
            before = len(out)
            _leave_casts(state, priority, now, out)
            room -= sum(len(datagram.data) for datagram in out[before:])
        for peer in peers:
            outbound = peer.outbound
            if not outbound.scheduler.waiting & bit:
                continue
            session = peer.session
            assert session is not None
            used = leave_level(outbound, session.way, priority, now, out, room, state.gates)
            if used:
                outbound.served |= bit
            room -= used
            if room <= 0:
                # Whoever used up the room stands behind the others next time.
                state.ready[peer] = state.ready.pop(peer)
                break
    for peer in peers:
        outbound = peer.outbound
        if outbound.served:
            outbound.levels.book_served(outbound.served, outbound.scheduler.waiting, now)
            outbound.served = 0
        if outbound.ended:
            report_ended(state, peer, now)
        if room > 0:
            state.ready.pop(peer, None)
            outbound.limited = not outbound.scheduler.waiting
        if held & outbound.scheduler.waiting:
            until = state.yielding.holds_until(now)
            if until is not None:
                peer.book_held(held & outbound.scheduler.waiting, now, until)
                outbound.wake_at = min(outbound.wake_at, until)
        state.arm(peer)


def _leave_casts(state: State, priority: int, now: float, out: list[Datagram]) -> None:
    rates = state.settings.rates
    urgent = priority <= rates.urgent_priority
    twice = urgent and any(peer.engaged and peer.outbound.send_twice for peer in state.roster.online())
    ways: list[tuple[str, Address | None]] = [
        (link.name, link.broadcast) for link in state.links.values() if link.kind is LinkKind.BROADCAST
    ]
    for peer in state.roster.online():
        session = peer.session
        if session is None:
            continue
        link = state.links.get(session.way.link)
        if link is not None and link.kind is LinkKind.NEIGHBOURS:
            ways.append((link.name, session.way.address))
    state.casts.leave(
        priority,
        state.to_all,
        ways,
        now,
        out,
        packets_per_s=None if urgent else rates.broadcast_packets_per_s,
        copy_after_s=rates.twice_gap_s if twice else None,
        kept_limit_bytes=state.settings.limits.repair_bytes,
        dated_bytes=_dated_bytes(state),
    )


def _dated_bytes(state: State) -> int:
    """The largest broadcast that may say when it left: none, where some peer takes no dates."""
    sessions = [peer.session for peer in state.roster.online() if peer.session is not None]
    return broadcast_room(state, sessions) if all(session.timed for session in sessions) else 0


def has_datagrams(state: State) -> bool:
    """See `Node.has_datagrams`."""
    return bool(state.owing or state.ready or state.outgoing or state.casts.waiting)


def is_quiet(state: State) -> bool:
    """See `Node.is_quiet`."""
    return not (has_datagrams(state) or state.ledger.waits)


def next_timer(state: State) -> float | None:
    """See `Node.next_timer`."""
    at = min(state.housekeeping_at, state.discovery.next_at, state.casts.next_at(), state.next_peer_at())
    for gate in state.gates.values():
        if gate.parked:
            at = min(at, gate.opens_at())
    if (state.packing or state.unpacking) and not state.closed:
        # At once, again and again; whatever else is due is done in between.
        return _ALWAYS
    return None if at == _INFINITY or state.closed else at


def handle_timer(state: State, now: float) -> None:
    """See `Node.handle_timer`."""
    if state.closed:
        return
    due_peers: list[Peer] = []
    while state.next_peer_at() <= now:
        _, _, peer = heappop(state.timers)
        peer.timer_at = peer.wants_at = _INFINITY
        due_peers.append(peer)
    for peer in due_peers:
        outbound = peer.outbound
        outbound.handle_timer(now)
        report_ended(state, peer, now)
        session = peer.session
        if session is not None:
            due = session.inbound.acks.due_at
            if due is not None and due <= now:
                session.inbound.acks.now_wanted = True
                session.inbound.acks.due_at = None
                state.owe(session)
            if outbound.probes_small(now):
                session.owe(Ping(state.rng.getrandbits(64)))
                state.owe(session)
        state.ready[peer] = None
        state.arm(peer)
    if state.discovery.next_at <= now:
        _send_heartbeats(state, now)
    for gate in state.gates.values():
        if gate.parked and gate.open(now):
            waiting = {outbound for outbound, _ in gate.parked}
            gate.release()
            for peer in state.roster.peers.values():
                if peer.engaged and peer.outbound in waiting:
                    state.ready[peer] = None
    casts: list[Datagram] = []
    state.casts.leave_copies(now, casts)
    state.outgoing.extend(casts)
    if state.packing:
        pack(state, now)
    if state.unpacking:
        unpack(state, now)
    if state.housekeeping_at <= now:
        state.housekeeping_at = now + HOUSEKEEPING_S
        housekeep(state, now)
        expire_held(state, now)
        _ask_for_repairs(state, now)


def _send_heartbeats(state: State, now: float) -> None:
    sessions = list(state.roster.sessions.values())
    waiting = state.yielding.waiting_here(state.waiting_outbounds(), now)
    sent = state.sent.per_s(now)
    beat = state.discovery.compose(state.settings, sessions, waiting, state.casts.next_number, sent, now)
    datagrams = announce(beat, state.to_all, state.links.values(), state.settings.neighbours)
    state.ledger.counters.heartbeats_sent += len(datagrams)
    state.outgoing.extend(datagrams)


def _ask_for_repairs(state: State, now: float) -> None:
    asking = list(state.asking)
    state.asking.clear()
    for boot_id in asking:
        repairs = state.repairs.get(boot_id)
        session = state.roster.sessions.get(boot_id)
        if repairs is None or session is None:
            continue
        asks = repairs.ask(now) if repairs.next_at <= now else []
        state.ask_by(boot_id, repairs)
        if not asks:
            continue
        state.ledger.counters.repairs_asked += len(asks)
        for ask in asks:
            session.owe(ask)
        state.owe(session)
