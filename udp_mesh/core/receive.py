"""Datagrams in: header -> channel -> opened frames -> effects. Never raises, whatever arrives.

1. A short header's tag selects candidate channels; opening one authenticates the sender. Few replays are
   decrypted (`receiver.copies`).
2. A plain fragment goes straight to reassembly; other frames are decoded and go to `frame_handlers`.
3. A long header introduces a boot: its check is verified before anything is derived or stored for it.
4. Datagrams of a boot before its first contact is proven are held, then processed as if they had just arrived.
"""

from udp_mesh.core.frame_handlers import ack_mid_batch, deliver, process_frames
from udp_mesh.core.peer_lifecycle import migrate_path, on_activity, on_bye, on_heartbeat, on_verified
from udp_mesh.core.peers.first_contact import hold, needs_proof, proves_contact
from udp_mesh.core.peers.path_validation import answer_pings
from udp_mesh.core.peers.peer_state import PeerState
from udp_mesh.core.peers.session import HeldDatagram, Session
from udp_mesh.core.receiver.copies import on_copy
from udp_mesh.core.receiver.replay_check import (
    broadcast_lateness_s,
    data_lateness_s,
    long_lateness_s,
    on_fresh_broadcast,
    on_fresh_data,
    small_frames,
    timestamp_of,
)
from udp_mesh.core.sender.path import IP_UDP_BYTES
from udp_mesh.core.sender.send_state import SendState
from udp_mesh.core.settings import Address
from udp_mesh.core.state import State
from udp_mesh.crypto import (
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
    Bye,
    Fragment,
    Frame,
    Heartbeat,
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

_SHORT = (DATA_BYTE, BROADCAST_BYTE)
_MIN_BYTES = SHORT_HEADER_BYTES + SEAL_TAG_BYTES

# Compared for every datagram: a global costs less than an enum member.
_ONLINE = PeerState.ONLINE
_UNRESPONSIVE = SendState.UNRESPONSIVE


def receive_datagram(state: State, data: bytes | memoryview, link: str, source: Address, now: float) -> None:
    """See `Endpoint.receive`."""
    counters = state.event_queue.counters
    size = len(data)
    counters.datagrams_received += 1
    counters.bytes_received += size + IP_UDP_BYTES
    if size < _MIN_BYTES:
        counters.dropped_malformed += 1
        return
    first = data[0]
    if first in _SHORT:
        to_one = first == DATA_BYTE
        replayed: tuple[ReceiveChannel, Session] | None = None
        _, tag, low = SHORT_HEADER.unpack_from(data)
        tags = state.peer_table.data_tags if to_one else state.peer_table.broadcast_tags
        for channel, session in tags.get(tag, ()):
            try:
                number, frames = channel.open(data, low)
            except ReplayError:
                # It may be a new packet of another channel with this tag.
                replayed = channel, session
                continue
            except OpenError:
                continue
            if to_one:
                session.received_bytes += size + IP_UDP_BYTES
                _receive_data(state, session, number, frames, link, source, now)
            else:
                _receive_broadcast(state, session, number, frames, link, source, now)
            return
        if replayed is not None:
            counters.dropped_replayed += 1
            on_copy(state, replayed[1], replayed[0], data, link, source, now)
        else:
            counters.dropped_unauthenticated += 1
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


def _receive_data(
    state: State, session: Session, number: int, frames: bytes, link: str, source: Address, now: float
) -> None:
    """Process a datagram bound to our current boot: its sender is alive, or was when it was recorded."""
    path = session.path
    peer = session.peer
    if not frames:
        state.event_queue.counters.dropped_malformed += 1
        return
    late_s: float | None = 0.0
    if frames[0] < FRAGMENT or now > session.freshness.trusted_until:
        late_s = data_lateness_s(state, session, frames, link, source, now)
        if late_s is None:
            return
        on_fresh_data(session, number, now)
    if (
        peer is not None
        and peer.state is _ONLINE
        and peer.session is session
        and source == path.address
        and link == path.link
        and (peer.sender is None or peer.sender.state is not _UNRESPONSIVE)
    ):
        session.last_heard = path.heard_at = now
    else:
        if not session.verified:
            if needs_proof(session):
                held = HeldDatagram(number, frames, link, source, introduced=False)
                hold(state, session, held, small_frames(frames), now)
                return
            on_verified(state, session, now)
        on_activity(state, session, link, source, now)
        peer = session.peer
        if peer is None or peer.session is not session:
            answer_pings(state, session, small_frames(frames), link, source, now)
            return
        if session.held:
            _release_held(state, session, now)
    receiver = session.receiver
    if receiver.receive_plain(frames, number, now):
        acks = receiver.acks
        if acks.send_now:
            state.control_ready[session] = None
            if receiver.ack_overdue():
                ack_mid_batch(state, session, now)
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
    process_frames(state, session, decoded, number, link, source, now, late_s or 0.0)


def _receive_broadcast(
    state: State, session: Session, number: int, frames: bytes, link: str, source: Address, now: float
) -> None:
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
    on_fresh_broadcast(session, number)
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
    deliver(state, session, now)


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
        try:
            number, frames = channel.open_long(data, header)
        except ReplayError:
            on_copy(state, session, channel, data, link, source, now)
            raise
        decoded = decode(frames)
        beat = _beat(decoded)
    else:
        number, frames = state.unknown_boots.channel(key, header).open_long(data, header)
        state.unknown_boots.forget(key, header)
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
    if introduced:
        session.received_bytes += len(data) + IP_UDP_BYTES
    if beat is not None and beat.name != session.name:
        state.event_queue.counters.dropped_malformed += 1
        return
    late_s = long_lateness_s(state, session, decoded, link, source, now)
    if late_s is None:
        return
    if not introduced:
        on_fresh_broadcast(session, number)
        if beat is not None:
            on_heartbeat(state, session, beat, link, source, now, to_all=True)
        for frame in decoded:
            if isinstance(frame, Bye) and session.verified:
                on_bye(state, session, now)
        if session.held and session.verified:
            _release_held(state, session, now)
        return
    on_fresh_data(session, number, now)
    if not session.verified:
        if beat is not None:
            session.update_from(beat, now)
            migrate_path(state, session, link, source, now)
        if beat is not None and proves_contact(state, session, beat, now):
            on_verified(state, session, now)
        elif needs_proof(session):
            hold(state, session, HeldDatagram(number, frames, link, source, introduced=True), decoded, now)
            return
    _process_introduction(state, session, decoded, beat, number, link, source, now, late_s)


def _process_introduction(
    state: State,
    session: Session,
    frames: list[Frame],
    beat: Heartbeat | None,
    number: int,
    link: str,
    source: Address,
    now: float,
    late_s: float,
) -> None:
    if beat is not None:
        on_heartbeat(state, session, beat, link, source, now, to_all=False)
    if session.verified and session.peer is not None:
        on_activity(state, session, link, source, now)
    if not session.is_current:
        answer_pings(state, session, frames, link, source, now)
        return
    if session.held:
        _release_held(state, session, now)
    process_frames(state, session, frames, number, link, source, now, late_s)
    # The sender uses long headers until it is answered.
    session.receiver.acks.send_now = True
    state.schedule_control(session)


def _release_held(state: State, session: Session, now: float) -> None:
    """Process the datagrams that came before the first contact was proven. Recordings among them are dropped as
    late."""
    held, session.held = session.held, []
    for datagram in held:
        number, frames, link, source, introduced = datagram
        if not introduced:
            _receive_data(state, session, number, frames, link, source, now)
            continue
        decoded = decode(frames)
        late_s = long_lateness_s(state, session, decoded, link, source, now)
        if late_s is not None:
            _process_introduction(state, session, decoded, _beat(decoded), number, link, source, now, late_s)


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
