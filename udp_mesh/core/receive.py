"""Datagrams in: header -> channel -> opened frames -> effects. Never raises, whatever arrives.

1. A short header's tag selects candidate channels; opening one authenticates the sender. Replays cost no decryption.
2. A plain fragment goes straight to reassembly; other frames are decoded and processed one by one.
3. A long header introduces a boot: its check is verified before anything is derived or stored for it.
"""

from udp_mesh.core.broadcast import FIRST_UNREPAIRED_NUMBER
from udp_mesh.core.conditions import Counters
from udp_mesh.core.events import ExpiryReason, MessageReceived
from udp_mesh.core.peer_lifecycle import migrate_path, on_activity, on_bye, on_heartbeat, on_verified
from udp_mesh.core.peers.path_validation import send_on_path
from udp_mesh.core.peers.peer_state import PeerState
from udp_mesh.core.peers.session import Session
from udp_mesh.core.publish import report_ended
from udp_mesh.core.receiver.replay_check import broadcast_lateness_s, data_lateness_s, long_lateness_s, timestamp_of
from udp_mesh.core.sender.message import AcceptedMessage, OutgoingMessage
from udp_mesh.core.sender.packetizer import IP_UDP_BYTES
from udp_mesh.core.sender.send_state import SendState
from udp_mesh.core.settings import Address
from udp_mesh.core.state import State
from udp_mesh.crypto import (
    SHORT_OVERHEAD_BYTES,
    TO_ALL,
    Key,
    OpenError,
    ReceiveChannel,
    ReplayError,
    UnknownKeyError,
    check_long,
)
from udp_mesh.wire.codec import decode
from udp_mesh.wire.errors import DecodeError, UnknownVersionError
from udp_mesh.wire.fragment import FRAGMENT
from udp_mesh.wire.frames import (
    Ack,
    Bye,
    Cancel,
    Delivered,
    Fragment,
    Frame,
    Heartbeat,
    Nack,
    Ping,
    Pong,
    Refused,
    RefuseReason,
    TopicAnnounce,
)
from udp_mesh.wire.header import (
    BROADCAST_BYTE,
    DATA_BYTE,
    SEAL_TAG_BYTES,
    SHORT_HEADER,
    SHORT_HEADER_BYTES,
    Kind,
    LongHeader,
    parse_header,
)

_MIN_BYTES = SHORT_HEADER_BYTES + SEAL_TAG_BYTES


def receive_datagram(state: State, data: bytes | memoryview, link: str, source: Address, now: float) -> None:
    """See `Node.receive`."""
    counters = state.event_queue.counters
    size = len(data)
    counters.datagrams_received += 1
    counters.bytes_received += size + IP_UDP_BYTES
    if size < _MIN_BYTES:
        counters.dropped_malformed += 1
        return
    first = data[0]
    if first == DATA_BYTE:
        replayed = False
        _, tag, low = SHORT_HEADER.unpack_from(data)
        for channel, session in state.peer_table.data_tags.get(tag, ()):
            try:
                number, frames = channel.open(data, low)
            except ReplayError:
                # It may be a new packet of another channel with this tag.
                replayed = True
                continue
            except OpenError:
                continue
            _receive_data(state, session, number, frames, link, source, now)
            return
        _count_unopened(counters, replayed=replayed)
    elif first == BROADCAST_BYTE:
        replayed = False
        _, tag, low = SHORT_HEADER.unpack_from(data)
        for channel, session in state.peer_table.broadcast_tags.get(tag, ()):
            try:
                _, frames = channel.open(data, low)
            except ReplayError:
                replayed = True
                continue
            except OpenError:
                continue
            _receive_broadcast(state, session, frames, link, source, now)
            return
        _count_unopened(counters, replayed=replayed)
    else:
        try:
            header = parse_header(data)
            if isinstance(header, LongHeader):
                _receive_long(state, data, header, link, source, now)
        except UnknownKeyError:
            counters.dropped_unauthenticated += 1
            mismatch = state.key_mismatches.on_mismatch(source, link, now)
            if mismatch is not None:
                state.event_queue.emit(mismatch)
        except ReplayError:
            counters.dropped_replayed += 1
        except OpenError:
            counters.dropped_unauthenticated += 1
        except UnknownVersionError:
            counters.dropped_malformed += 1
        except DecodeError:
            counters.dropped_malformed += 1


def _count_unopened(counters: Counters, *, replayed: bool) -> None:
    if replayed:
        counters.dropped_replayed += 1
    else:
        counters.dropped_unauthenticated += 1


def _receive_data(
    state: State, session: Session, number: int, frames: bytes, link: str, source: Address, now: float
) -> None:
    """Process a datagram bound to our current boot: its sender is alive, or was when it was recorded."""
    path = session.path
    peer = session.peer
    session.received_bytes += len(frames) + SHORT_OVERHEAD_BYTES + IP_UDP_BYTES
    if not frames:
        state.event_queue.counters.dropped_malformed += 1
        return
    late_s: float | None = 0.0
    if frames[0] < FRAGMENT or now > session.freshness.trusted_until:
        late_s = data_lateness_s(state, session, frames, link, source, now)
        if late_s is None:
            return
    if (
        peer is not None
        and peer.state is PeerState.ONLINE
        and peer.session is session
        and source == path.address
        and link == path.link
        and peer.sender.state is not SendState.UNRESPONSIVE
    ):
        session.last_heard = path.heard_at = now
    else:
        if not session.verified:
            on_verified(state, session, now)
        on_activity(state, session, link, source, now)
        peer = session.peer
        if peer is None or peer.session is not session:
            return
    receiver = session.receiver
    if receiver.receive_plain(frames, number, now):
        acks = receiver.acks
        if acks.send_now:
            state.control_ready[session] = None
            if receiver.ack_overdue():
                _ack_mid_batch(state, session, now)
        elif acks.due_at is not None and acks.due_at < peer.due_at:
            state.set_timer(peer, acks.due_at)
        return
    try:
        decoded = decode(frames)
    except DecodeError:
        state.event_queue.counters.dropped_malformed += 1
        return
    if session.timed and timestamp_of(frames) is None:
        # Its sender timestamps every first fragment: one without a timestamp could be replayed later.
        decoded = [frame for frame in decoded if not (isinstance(frame, Fragment) and frame.head is not None)]
    _receive_frames(state, session, decoded, number, link, source, now, late_s or 0.0)


def _receive_frames(
    state: State,
    session: Session,
    frames: list[Frame],
    number: int,
    link: str,
    source: Address,
    now: float,
    late_s: float = 0.0,
) -> None:
    """Process the frames of a unicast datagram, in order."""
    receiver = session.receiver
    peer = session.peer
    assert peer is not None
    sender = peer.sender
    wants_ack = ack_now = False
    kept = True
    for frame in frames:
        match frame:
            case Fragment():
                wants_ack = True
                ack_now = ack_now or frame.ack_now
                kept = receiver.receive_fragment(frame, now, broadcast=False, late_s=late_s) and kept
            case Ack():
                if frame.largest < session.path.channel.next_number:
                    session.path.confirmed = session.knows_us = True
                    session.peer_receives = (frame.receive_rate, now)
                    arrived_before = sender.delivered_packets
                    sender.acknowledge(frame, now)
                    if sender.delivered_packets > arrived_before:
                        session.confirm_two_way()
                    report_ended(state, peer, now)
                    state.ready[peer] = None
                if frame.waiting:
                    state.priority_backoff.on_waiting(frame.waiting, now)
            case TopicAnnounce():
                receiver.on_topic_announce(frame)
            case Cancel(message_ids, broadcast_ids):
                _on_cancel(state, session, message_ids, broadcast_ids=broadcast_ids)
            case Refused():
                if not frame.broadcast_id:
                    _on_refused(state, session, frame)
                    report_ended(state, peer, now)
                    state.ready[peer] = None
            case Delivered(message_ids, broadcast_ids):
                if not broadcast_ids:
                    sender.on_delivered(message_ids)
                    report_ended(state, peer, now)
            case Nack(message_id):
                _on_nack(state, session, message_id, now)
            case Ping(token):
                if (link, source) == (session.path.link, session.path.address):
                    session.queue_control(Pong(token, 0))
                    state.schedule_control(session)
                else:
                    # The ping validates the path it came on: answer to that address.
                    send_on_path(state, session, Pong(token, 0), link, source, now)
            case Pong(token):
                sender.pmtu.on_pong(token, now)
            case Bye():
                on_bye(state, session, now)
            case _:
                # Heartbeats are processed with long headers.
                pass
    _deliver(state, session, now)
    if not wants_ack:
        receiver.acks.on_packet(number, now)
    elif kept:
        receiver.on_accepted(number, now, ack_now=ack_now)
        if receiver.acks.send_now:
            state.schedule_control(session)
    if receiver.refusals:
        for refusal in receiver.refusals:
            session.queue_control(refusal)
        receiver.refusals.clear()
        state.schedule_control(session)
    state.arm(peer)


def _ack_mid_batch(state: State, session: Session, now: float) -> None:
    """Acknowledge in the middle of a large batch, before its beginning leaves the bitmap."""
    ack = session.build_ack(now, ())
    if ack is not None:
        session.queue_control(ack)


def _on_cancel(state: State, session: Session, message_ids: tuple[int, ...], *, broadcast_ids: bool) -> None:
    if broadcast_ids:
        repairs = state.repairs.get(session.boot_id)
        for message_id in message_ids:
            if repairs is not None:
                repairs.abandon(message_id)
        return
    for message_id in message_ids:
        session.receiver.unicasts.end(message_id)


def _on_refused(state: State, session: Session, refused: Refused) -> None:
    peer = session.peer
    assert peer is not None
    sender = peer.sender
    message = sender.by_wire_id(refused.message_id)
    if message is None:
        return
    match refused.reason:
        case RefuseReason.FORGOTTEN:
            sender.resend_from_start(message)
        case RefuseReason.NO_MEMORY:
            # Its packets stay unacknowledged and are retransmitted anyway.
            return
        case RefuseReason.TOO_LARGE | RefuseReason.CORRUPT:
            sender.finish(message, ExpiryReason.REFUSED)


def _on_nack(state: State, session: Session, number: int, now: float) -> None:
    """A peer misses a broadcast: send it a unicast copy, or a Cancel if it is no longer kept."""
    peer = session.peer
    assert peer is not None
    accepted = state.broadcasts.repair(number)
    if accepted is None:
        session.queue_control(Cancel((number,), broadcast_ids=True))
        state.schedule_control(session)
        return
    if any(message.accepted.broadcast_number == number for message in peer.sender.pending):
        return
    state.event_queue.counters.repairs_sent += 1
    copy = AcceptedMessage(
        accepted.message_id,
        accepted.channel,
        accepted.payload,
        accepted.body,
        accepted.flags,
        accepted.accepted_at,
        accepted.deadline,
        number,
    )
    peer.sender.accept(OutgoingMessage(copy, accepted.channel.topic.priority, reliable=True), now)
    state.ready[peer] = None


def _deliver(state: State, session: Session, now: float) -> None:
    """Turn complete messages into events."""
    receiver = session.receiver
    if receiver.inflating:
        state.inflating[session] = None
    if not receiver.completed:
        return
    completed, receiver.completed = receiver.completed, []
    repairs = state.repairs.get(session.boot_id)
    for message in completed:
        number = message.from_broadcast
        if number is not None and number < FIRST_UNREPAIRED_NUMBER and repairs is not None:
            repairs.on_received(number, now, receiver.broadcasts.finished)
            state.schedule_repair(session.boot_id, repairs)
        state.event_queue.counters.messages_received += 1
        state.event_queue.emit(
            MessageReceived(
                session.name, message.topic, message.type_name, message.payload, message.priority, message.to_all
            )
        )


def inflate_step(state: State, now: float) -> None:
    """Inflate one step of a complete message, of each session in turn."""
    session = next(iter(state.inflating))
    held = sum(one.receiver.inflating_bytes for one in state.inflating)
    if not session.receiver.inflate_step():
        state.event_queue.counters.dropped_malformed += 1
    if held <= 2 * state.settings.limits.message_bytes or not session.receiver.inflating:
        # In turn, unless much memory is held already: then finish this one before others grow.
        del state.inflating[session]
    _deliver(state, session, now)


def _receive_broadcast(state: State, session: Session, frames: bytes, link: str, source: Address, now: float) -> None:
    """Process a broadcast datagram. Until the sender is verified and its floor known, it may be replayed."""
    peer = session.peer
    if peer is None or peer.session is not session or session.boot_id not in state.repairs:
        state.event_queue.counters.dropped_unproven += 1
        return
    if not frames:
        state.event_queue.counters.dropped_malformed += 1
        return
    late_s = broadcast_lateness_s(state, session, frames, link, source, now)
    if late_s is None:
        return
    on_activity(state, session, link, source, now)
    try:
        decoded = decode(frames)
    except DecodeError:
        state.event_queue.counters.dropped_malformed += 1
        return
    for frame in decoded:
        match frame:
            case Fragment():
                session.receiver.receive_fragment(frame, now, broadcast=True, late_s=late_s)
            case TopicAnnounce():
                session.receiver.on_topic_announce(frame)
            case Bye():
                on_bye(state, session, now)
            case _:
                pass
    session.receiver.refusals.clear()
    _deliver(state, session, now)


def _receive_long(
    state: State, data: bytes | memoryview, header: LongHeader, link: str, source: Address, now: float
) -> None:
    """Process a HELLO or an INTRODUCTION. Raises the decoder's and the cipher's errors."""
    if header.boot_id == state.boot_id:
        return
    key = _key(state, header.key_id)
    check_long(key, data, header)
    session = state.peer_table.sessions.get(header.boot_id)
    introduced = header.kind is Kind.INTRODUCTION
    if session is not None:
        channel = _channel(session.data_channels if introduced else session.broadcast_channels, key)
        number, frames = channel.open_long(data, header)
        decoded = decode(frames)
        beat = _beat(decoded)
    else:
        channel = ReceiveChannel(key, header.boot_id, state.boot_id if introduced else TO_ALL)
        number, frames = channel.open_long(data, header)
        decoded = decode(frames)
        beat = _beat(decoded)
        if beat is None:
            # An introduction without a name: its sender assumes that we know it. Wait for its heartbeat.
            state.event_queue.counters.dropped_unproven += 1
            return
        session = state.peer_table.add_unverified(beat.name, header.boot_id, state.keys, state.settings)
        channel = _channel(session.data_channels if introduced else session.broadcast_channels, key)
        if not channel.window.accept(number):
            # The session was forgotten, but its counters were restored: a replay.
            state.peer_table.forget(session)
            raise ReplayError(f"packet {number} was already seen or is too old")
    if beat is not None and beat.name != session.name:
        state.event_queue.counters.dropped_malformed += 1
        return
    late_s = long_lateness_s(state, session, decoded, link, source, now)
    if late_s is None:
        return
    if not introduced:
        if beat is not None:
            on_heartbeat(state, session, beat, link, source, now, to_all=True)
        for frame in decoded:
            if isinstance(frame, Bye) and session.verified:
                on_bye(state, session, now)
        return
    if beat is not None and not session.verified:
        session.update_from(beat, now)
        migrate_path(state, session, link, source, now)
        on_verified(state, session, now)
    if beat is not None:
        on_heartbeat(state, session, beat, link, source, now, to_all=False)
    if not session.verified or session.peer is None:
        return
    on_activity(state, session, link, source, now)
    if session.peer.session is not session:
        return
    _receive_frames(state, session, decoded, number, link, source, now, late_s)
    # The sender uses long headers until it is answered.
    session.receiver.acks.send_now = True
    state.schedule_control(session)


def _key(state: State, key_id: bytes) -> Key:
    for key in state.keys:
        if key.key_id == key_id:
            return key
    raise UnknownKeyError(key_id)


def _channel(channels: list[ReceiveChannel], key: Key) -> ReceiveChannel:
    """The session's channel under a live key."""
    for channel in channels:
        if channel.key is key or channel.key == key:
            return channel
    raise UnknownKeyError(key.key_id)


def _beat(frames: list[Frame]) -> Heartbeat | None:
    for frame in frames:
        if isinstance(frame, Heartbeat):
            return frame
    return None
