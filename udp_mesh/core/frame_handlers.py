"""The frames of an opened unicast datagram: fragments to reassembly, acknowledgments to the sender, requests answered.

`deliver` turns complete messages into events; `inflate_step` does so for compressed ones, step by step.
"""

from udp_mesh.core.broadcast import FIRST_UNREPAIRED_NUMBER
from udp_mesh.core.events import ExpiryReason, MessageReceived, Receipt
from udp_mesh.core.peer_lifecycle import on_bye
from udp_mesh.core.peers.path_validation import send_on_path
from udp_mesh.core.peers.session import Session
from udp_mesh.core.peers.session_state import Reception, ReceptionEvent
from udp_mesh.core.publish import report_ended
from udp_mesh.core.sender.message import AcceptedMessage, OutgoingMessage
from udp_mesh.core.settings import Address
from udp_mesh.core.state import State
from udp_mesh.wire.frames import (
    Ack,
    Bye,
    Cancel,
    Delivered,
    Fragment,
    Frame,
    Nack,
    Ping,
    Pong,
    Refused,
    RefuseReason,
    TopicAnnounce,
)


def process_frames(
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
    sender = peer.open_sender()
    wants_ack = ack_now = False
    kept = True
    duplicates = receiver.duplicates - receiver.fragments
    for frame in frames:
        match frame:
            case Fragment():
                wants_ack = True
                ack_now = ack_now or frame.ack_now
                kept = receiver.receive_fragment(frame, now, broadcast=False, late_s=late_s) and kept
            case Ack():
                if frame.largest < session.path.channel.next_number:
                    session.path.confirmed = True
                    if session.reception is Reception.UNKNOWN:
                        session.on_reception(ReceptionEvent.ACKNOWLEDGED, now)
                    session.peer_receives = (frame.receive_rate, now)
                    arrived_before = sender.delivered_packets
                    sender.acknowledge(frame, now)
                    if sender.delivered_packets > arrived_before:
                        session.on_reception(ReceptionEvent.CONFIRMED, now)
                    report_ended(state, peer, now)
                    state.ready[peer] = None
                if frame.waiting:
                    state.priority_backoff.on_waiting(frame.waiting, now)
            case TopicAnnounce():
                receiver.on_topic_announce(frame)
            case Cancel(message_ids, broadcast_ids):
                _on_cancel(state, session, message_ids, broadcast_ids=broadcast_ids)
            case Refused():
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
                    send_on_path(state, session, [Pong(token, 0)], link, source, now)
            case Pong(token):
                sender.pmtu.on_pong(token, now)
            case Bye():
                on_bye(state, session, now)
            case _:
                # Heartbeats are processed with long headers.
                pass
    deliver(state, session, now)
    deferred = receiver.take_deferred()
    if not wants_ack:
        receiver.acks.on_packet(number, now)
    elif kept and deferred is not None:
        deferred.numbers.append(number)
    elif kept:
        # A copy that brings nothing new does not call for an acknowledgment of its own: the next one covers it.
        is_new = receiver.duplicates - receiver.fragments != duplicates
        receiver.on_accepted(number, now, ack_now=ack_now and is_new)
        if receiver.acks.send_now:
            state.schedule_control(session)
            if receiver.ack_overdue():
                ack_mid_batch(state, session, now)
    if receiver.confirmed:
        state.schedule_control(session)
    _send_refusals(state, session)
    state.arm(peer)


def _send_refusals(state: State, session: Session) -> None:
    refusals = session.receiver.refusals
    if refusals:
        for refusal in refusals:
            session.queue_control(refusal)
        refusals.clear()
        state.schedule_control(session)


def ack_mid_batch(state: State, session: Session, now: float) -> None:
    """Acknowledge in the middle of a large batch, before its beginning leaves the bitmap."""
    for ack in session.build_acks(now, ()):
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
    sender = peer.open_sender()
    if refused.broadcast_id:
        # Its number means this broadcast whatever its fragments are, so it cannot be started again under another one.
        repair = sender.by_broadcast_number(refused.message_id)
        if repair is not None and refused.reason is not RefuseReason.NO_MEMORY:
            sender.finish(repair, ExpiryReason.REFUSED)
        return
    message = sender.by_wire_id(refused.message_id)
    if message is None:
        if refused.reason is RefuseReason.FORGOTTEN:
            state.versions.of(peer.name).on_best_effort_refused()
        return
    match refused.reason:
        case RefuseReason.FORGOTTEN:
            if message.version is not None:
                message.version.on_refused(message)
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
    sender = peer.open_sender()
    if sender.by_broadcast_number(number) is not None:
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
    sender.accept(OutgoingMessage(copy, accepted.channel.topic.priority, reliable=True), now)
    state.ready[peer] = None


def deliver(state: State, session: Session, now: float) -> None:
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
        if state.on_subscriptions(session, message.topic, message.payload, now):
            continue
        thin_number, confirm_id = message.thin_number, message.confirm_id
        if thin_number is not None and not state.thin_copies.is_first(session.boot_id, thin_number):
            # A thin link was faster.
            if confirm_id is not None and receiver.confirm(confirm_id):
                state.schedule_control(session)
            continue
        state.event_queue.counters.messages_received += 1
        state.event_queue.emit(
            MessageReceived(
                session.name,
                message.topic,
                message.type_name,
                message.payload,
                message.priority,
                message.to_all,
                None if confirm_id is None else Receipt(session.boot_id, confirm_id),
            )
        )


def inflate_step(state: State, now: float) -> None:
    """Inflate one step of a complete message, of each session in turn."""
    session = next(iter(state.inflating))
    held = sum(other.receiver.inflating_bytes for other in state.inflating)
    version = session.receiver.inflating[0].numbers
    if not session.receiver.inflate_step(now) and not version:
        state.event_queue.counters.dropped_malformed += 1
    if version:
        _send_refusals(state, session)
        state.schedule_control(session)
    if held <= 2 * state.settings.limits.message_bytes or not session.receiver.inflating:
        # In turn, unless much memory is held already: then finish this one before others grow.
        del state.inflating[session]
    deliver(state, session, now)
