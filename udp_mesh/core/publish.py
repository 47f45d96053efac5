"""Messages in: topic -> destinations -> a peer's queue, the broadcast queue or an outbox; outcomes out as events.

`send` chooses where a message goes; a large one is first compressed in steps by `compress_step`. `store_in_outbox` and
`release_outbox` move messages between a peer's queue and its outbox as the peer goes offline and returns.
`report_ended` turns outcomes into events.
"""

from collections.abc import Iterable, Sequence
from itertools import zip_longest

from udp_mesh.core.capacity import check_capacity
from udp_mesh.core.compression import STEP_BYTES, Uncompressed, compress
from udp_mesh.core.events import (
    ExpiryReason,
    MessageDelivered,
    MessageExpired,
    MessageId,
    MessagePeerLost,
    Rejected,
    RejectReason,
)
from udp_mesh.core.legacy.sender import can_publish
from udp_mesh.core.outbox import HeldMessage
from udp_mesh.core.peers.features import acceptable, all_accept
from udp_mesh.core.peers.peer_state import PeerState
from udp_mesh.core.peers.session import Peer, Session
from udp_mesh.core.sender.message import AcceptedMessage, OutgoingMessage, TopicChannel
from udp_mesh.core.sender.path import IP_UDP_BYTES, header_bytes
from udp_mesh.core.sender.pending import Outcome
from udp_mesh.core.sender.pmtu import ETHERNET_MTU
from udp_mesh.core.sender.rate_limit import TokenBucket
from udp_mesh.core.sender.send_quota import pack_until
from udp_mesh.core.setting_checks import is_type_name
from udp_mesh.core.settings import Outbox, Topic
from udp_mesh.core.state import State
from udp_mesh.core.subscriptions.messages import is_about_subscriptions
from udp_mesh.core.thin.numbering import numbered, unnumbered
from udp_mesh.core.versions.outgoing import OutgoingVersion
from udp_mesh.crypto import SHORT_OVERHEAD_BYTES
from udp_mesh.wire.codec import ANNOUNCE_BYTES
from udp_mesh.wire.fragment import FRAGMENT_BYTES, HEAD_BYTES, LENGTH_BYTES
from udp_mesh.wire.frames import Feature, MessageFlag
from udp_mesh.wire.legacy import LEGACY_OVERHEAD_BYTES
from udp_mesh.wire.limits import MAX_TYPE_BYTES
from udp_mesh.wire.thin import ThinBody

RELEASE_BATCH = 400
"""Outbox messages queued at a time: some milliseconds, in which no urgent message can be sent."""

RELEASE_INTERVAL_S = 0.02
"""Time between two batches: 20,000 messages a second, more than a robot's link carries."""

MAX_CHANNELS = 65_536
"""Topic numbers are 16 bits."""


def send(
    state: State,
    topic_name: str,
    payload: bytes,
    destination: str | None,
    type_name: str,
    now: float,
    *,
    thin_number: int | None = None,
) -> MessageId | Rejected:
    """See `Endpoint.send`. `thin_number` is that of the copies on thin links, if there are any."""
    if state.closed:
        return Rejected(RejectReason.CLOSED, "the node is closed")
    topic = state.named_topic(topic_name)
    if topic is None:
        return Rejected(RejectReason.UNKNOWN_TOPIC, f"topic {topic_name} is not declared")
    limits = state.settings.limits
    if len(payload) > limits.message_bytes:
        return Rejected(RejectReason.TOO_LARGE, f"expected at most {limits.message_bytes} bytes, found {len(payload)}")
    channel = topic_channel(state, topic, type_name)
    if channel is None:
        return Rejected(
            RejectReason.UNKNOWN_TOPIC,
            f"too many topics, or the type name is not printable text of at most {MAX_TYPE_BYTES} bytes",
        )
    wanted = topic.destinations if destination is None else (destination,)
    names = [name for name in wanted if name != state.settings.name]
    if wanted and not names:
        return Rejected(RejectReason.UNKNOWN_PEER, f"{wanted[0]} is this node, and messages go to others")
    rejected = check_capacity(state, topic, names, len(payload))
    if rejected is not None:
        return rejected
    message_id = MessageId(state.next_message_id)
    state.next_message_id += 1
    state.event_queue.counters.messages_sent += 1
    compression = topic.compression and not (topic.delta and all_accept(state, names, Feature.VERSIONS))
    zstd = compression and all_accept(state, names, Feature.ZSTD)
    if compression and (len(payload) > STEP_BYTES or state.compression_queue.has_topic(topic.name)):
        plain = _accept(message_id, channel, payload, None, now)
        keys = tuple(state.outboxes.persist(name, plain, now) for name in names) if topic.reliable else ()
        state.compression_queue.add(Uncompressed(message_id, channel, payload, tuple(names), now, keys, zstd))
    else:
        packed = compress(payload, zstd=zstd) if compression else None
        accepted = numbered(_accept(message_id, channel, payload, packed, now, zstd=zstd), thin_number)
        _enqueue_all(state, accepted, names, now)
    return message_id


def send_later(
    state: State,
    message_id: MessageId,
    topic_name: str,
    body: ThinBody,
    name: str,
    *,
    accepted_at: float,
    thin_number: int,
    now: float,
) -> bool:
    """Queue a message that only thin links carried so far to a peer that is online now, under its identifier and number
    of before. False if there is no room, or no such topic any more."""
    topic = state.named_topic(topic_name)
    channel = None if topic is None else topic_channel(state, topic, body.type_name)
    if topic is None or channel is None or check_capacity(state, topic, [name], len(body.payload)) is not None:
        return False
    enqueue(state, name, numbered(_accept(message_id, channel, body.payload, None, accepted_at), thin_number), now)
    return True


def compress_step(state: State, now: float) -> None:
    """Compress one step; queue a message when it is done."""
    done = state.compression_queue.step()
    if done is not None:
        message, packed = done
        accepted = _accept(
            message.message_id, message.channel, message.payload, packed, message.accepted_at, zstd=message.zstd
        )
        _enqueue_all(state, accepted, message.names, now, message.store_keys)


def flush_compression(state: State, now: float) -> None:
    """Queue everything that waits for compression, uncompressed."""
    for message in state.compression_queue.drain():
        accepted = _accept(message.message_id, message.channel, message.payload, None, message.accepted_at)
        _enqueue_all(state, accepted, message.names, now, message.store_keys)


def _enqueue_all(
    state: State, accepted: AcceptedMessage, names: Sequence[str], now: float, store_keys: Sequence[int | None] = ()
) -> None:
    if len(names) == 1 and not store_keys:
        enqueue(state, names[0], accepted, now)
    elif names:
        for name, store_key in zip_longest(names, store_keys):
            enqueue(state, name, accepted, now, store_key)
    else:
        _broadcast(state, accepted, now)


def topic_channel(state: State, topic: Topic, type_name: str) -> TopicChannel | None:
    """The topic's number on the wire with this type. None if there are too many, or if no receiver would accept the
    type name: receivers drop every datagram that announces it, with everything else in it."""
    channel = state.channels.get((topic.name, type_name))
    if channel is None:
        if len(state.channels) >= MAX_CHANNELS or not is_type_name(type_name):
            return None
        channel = TopicChannel(len(state.channels), topic, topic.name, type_name)
        state.channels[(topic.name, type_name)] = channel
    return channel


def _accept(
    message_id: MessageId,
    channel: TopicChannel,
    payload: bytes,
    packed: bytes | None,
    accepted_at: float,
    *,
    zstd: bool = False,
) -> AcceptedMessage:
    topic = channel.topic
    flags = MessageFlag.RELIABLE if topic.reliable else 0
    if packed is not None:
        flags |= MessageFlag.COMPRESSED | (MessageFlag.ZSTD if zstd else 0)
    deadline = None if topic.deadline_s is None else accepted_at + topic.deadline_s
    body = payload if packed is None else packed
    return AcceptedMessage(message_id, channel, payload, body, flags, accepted_at, deadline)


def enqueue(state: State, name: str, accepted: AcceptedMessage, now: float, store_key: int | None = None) -> None:
    """Queue one destination's copy: to the peer if it is online, otherwise to the topic's outbox."""
    topic = accepted.channel.topic
    peer = state.peer_table.get_or_create(name, state.settings)
    if peer is None or ((not peer.online) and topic.outbox is not Outbox.NONE):
        _hold(state, name, HeldMessage(accepted, store_key), now)
        return
    admitted = state.selection.admit(peer, accepted, now)
    if admitted is None:
        return
    accepted = unnumbered(admitted) if peer.session is None else acceptable(admitted, peer.session)
    keeps = topic.outbox is not Outbox.NONE and peer.settling
    if (keeps or state.outboxes.holds(name, topic.name)) and topic.priority > state.settings.rates.urgent_priority:
        # Older messages of the topic still wait in the outbox; only urgent ones go ahead of stale ones.
        _hold(state, name, HeldMessage(accepted, store_key), now)
        return
    if store_key is None and topic.reliable:
        store_key = state.outboxes.persist(name, accepted, now)
    _queue(state, peer, accepted, now, store_key)


def _queue(state: State, peer: Peer, accepted: AcceptedMessage, now: float, store_key: int | None) -> None:
    """Queue a message to a peer, online or not."""
    topic = accepted.channel.topic
    message = OutgoingMessage(accepted, topic.priority, reliable=topic.reliable)
    message.store_key = store_key
    if topic.delta:
        message.version = OutgoingVersion(state.versions.of(peer.name))
    sender = peer.open_sender()
    if peer.state is PeerState.LOST:
        # It never waits: until the peer is heard, which may be never, nothing would take it out of the scheduler.
        sender.add(message)
        sender.finish(message, Outcome.PEER_LOST)
        report_ended(state, peer, now)
        return
    sender.accept(message, now)
    if topic.rate_limit_bytes_per_s is not None and topic.name not in state.rate_limits:
        state.rate_limits[topic.name] = TokenBucket(topic.rate_limit_bytes_per_s, now)
    if sender.ended:
        report_ended(state, peer, now)
    session = peer.session
    shared_at = now if session is None else pack_until(sender, topic.priority, session.path.room_bytes, now)
    if shared_at <= now:
        state.ready[peer] = None
        state.arm(peer)
    elif shared_at < sender.wake_at:
        sender.wake_at = shared_at
        state.arm(peer)


def _broadcast(state: State, accepted: AcceptedMessage, now: float) -> None:
    topic = accepted.channel.topic
    accepted = accepted._replace(flags=accepted.flags | MessageFlag.TO_ALL)
    sessions = [peer.session for peer in state.peer_table.online() if peer.session is not None]
    # With peers of earlier versions each gets its own copy, so that the others have the number.
    same_for_all = not accepted.flags & MessageFlag.NUMBERED or all_accept(state, (), Feature.THIN)
    for session in sessions if same_for_all else ():
        accepted = acceptable(accepted, session)
    fits = same_for_all and state.can_broadcast() and _broadcast_bytes(accepted) <= broadcast_room(state, sessions)
    if fits:
        broadcast_wanted(state, accepted, now)
    for peer in list(state.peer_table.peers.values()):
        if peer.legacy and not can_publish(accepted.channel.type_name):
            continue
        if (peer.online and (not fits or peer.legacy)) or (not peer.online and topic.outbox is not Outbox.NONE):
            enqueue(state, peer.name, accepted, now)


def broadcast_wanted(state: State, accepted: AcceptedMessage, now: float) -> None:
    """Broadcast a message that fits a datagram, if some peer wants it now."""
    admitted = state.selection.admit_to_all(state.peer_table.online(), accepted, now)
    if admitted is not None:
        state.broadcasts.push(admitted)


def broadcast_room(state: State, sessions: Iterable[Session]) -> int:
    """Size of a datagram that every known path carries. On links with a larger MTU than Ethernet's it is still limited
    to Ethernet's: a mesh behind such a link may not carry more, and a lost broadcast is not noticed."""
    links = [link.mtu - header_bytes(link.address) for link in state.links.values()]
    paths = [path.mtu - header_bytes(path.address) for path in (session.path for session in sessions) if path.link]
    room = min([*links, *paths, max(ETHERNET_MTU, state.settings.fragment_bytes) - IP_UDP_BYTES], default=0)
    if any(neighbour.legacy for neighbour in state.settings.neighbours):
        room -= LEGACY_OVERHEAD_BYTES
    return room


def _broadcast_bytes(accepted: AcceptedMessage) -> int:
    """Size of the datagram that broadcasts this message."""
    channel = accepted.channel
    names = ANNOUNCE_BYTES + len(channel.name.encode()) + len(channel.type_name.encode())
    fragment = FRAGMENT_BYTES + HEAD_BYTES + LENGTH_BYTES + len(accepted.body)
    return SHORT_OVERHEAD_BYTES + names + fragment


def store_in_outbox(state: State, peer: Peer, now: float) -> None:
    """Move messages from the queue of a peer that went offline to their outboxes."""
    sender = peer.sender
    if sender is None:
        return
    everything = list(sender.pending)
    # Newest first: each one goes in front of those already there.
    everything.sort(key=lambda message: message.accepted.message_id, reverse=True)
    for message in everything:
        if message.accepted.channel.topic.outbox is Outbox.NONE or message.accepted.broadcast_number is not None:
            continue
        # Best effort is not remembered for long by the receiver, and legacy programs do not know our numbers.
        resumable = message.started and message.reliable and not peer.legacy
        sender.withdraw(message, to_resume=resumable)
        started = message if resumable else None
        _hold(state, peer.name, HeldMessage(message.accepted, message.store_key, started, sender.epoch), now)


def _hold(state: State, name: str, new: HeldMessage, now: float) -> None:
    for held, reason in state.outboxes.hold(name, new, now):
        _drop_held(state, name, held, reason)


def _drop_held(state: State, name: str, held: HeldMessage, reason: ExpiryReason) -> None:
    """Drop a message from an outbox; the peer may discard what it has of it."""
    peer = state.peer_table.peers.get(name)
    sender = peer.sender if peer is not None else None
    if held.started is not None and sender is not None and held.epoch == sender.epoch:
        sender.cancel(held.started)
    report_expired(state, name, held.accepted, reason)


def release_outbox(state: State, peer: Peer, now: float) -> None:
    """The peer is online: queue some of its outbox, most urgent and oldest first; more of it soon."""
    for held in state.outboxes.release(peer.name, RELEASE_BATCH):
        started, session, sender = held.started, peer.session, peer.sender
        if started is not None and sender is not None and held.epoch == sender.epoch:
            # A message sent completely may have arrived completely; under a new number it would arrive twice.
            fully_sent = started.next_position >= started.fragments
            if session is not None and (fully_sent or started.fragment_bytes <= session.path.fragment_bytes):
                started.store_key = held.store_key
                sender.resume(started, now)
                state.ready[peer] = None
                state.arm(peer)
                continue
            sender.cancel(started)
        accepted = unnumbered(held.accepted) if session is None else acceptable(held.accepted, session)
        _queue(state, peer, accepted, now, held.store_key)
    if state.outboxes.holds(peer.name):
        state.maintenance_at = min(state.maintenance_at, now + RELEASE_INTERVAL_S)


def withdraw(state: State, name: str, message_id: MessageId, now: float) -> None:
    """Send no more of a message to a peer that does not need it: it ends as superseded, unless it has ended already."""
    _finish(state, name, message_id, ExpiryReason.SUPERSEDED, now)


def _finish(state: State, name: str, message_id: MessageId, outcome: Outcome | ExpiryReason, now: float) -> None:
    peer = state.peer_table.peers.get(name)
    if peer is None or peer.sender is None:
        return
    for message in peer.sender.pending:
        if message.accepted.message_id == message_id:
            peer.sender.finish(message, outcome)
            break
    report_ended(state, peer, now)
    state.ready[peer] = None
    state.arm(peer)


def delivered_elsewhere(state: State, name: str, message_id: MessageId, now: float) -> None:
    """A thin link delivered a message to a peer: it ends as delivered, unless it has ended or waits in an outbox."""
    _finish(state, name, message_id, Outcome.DELIVERED, now)


def report_ended(state: State, peer: Peer, now: float) -> None:
    """Turn the outcomes of messages to one peer into events."""
    sender = peer.sender
    if sender is None or not sender.ended:
        return
    ended, sender.ended = sender.ended, []
    counters = state.event_queue.counters
    for message, outcome in ended:
        accepted = message.accepted
        if message.store_key is not None:
            state.outboxes.forget(message.store_key)
        topic = accepted.channel.name
        if accepted.broadcast_number is not None or is_about_subscriptions(topic):
            continue
        if outcome is Outcome.SENT:
            continue
        if outcome is Outcome.DELIVERED:
            if message.version is not None:
                message.version.on_delivered(message)
            counters.messages_delivered += 1
            if message.reliable:
                latency_s = now - accepted.accepted_at
                state.event_queue.emit(MessageDelivered(accepted.message_id, peer.name, topic, latency_s))
        elif outcome is Outcome.PEER_LOST:
            counters.messages_peer_lost += 1
            if message.reliable:
                state.event_queue.emit(MessagePeerLost(accepted.message_id, peer.name, topic))
        elif isinstance(outcome, ExpiryReason):
            if outcome is ExpiryReason.DEADLINE:
                state.selection.on_deadline(peer.name, accepted)
            report_expired(state, peer.name, accepted, outcome)


def report_expired(state: State, peer: str, accepted: AcceptedMessage, reason: ExpiryReason) -> None:
    """Report an accepted message that was given up."""
    state.event_queue.counters.messages_expired += 1
    if accepted.flags & MessageFlag.RELIABLE:
        state.event_queue.emit(MessageExpired(accepted.message_id, peer, accepted.channel.name, reason))


def expire_held(state: State, now: float) -> None:
    """Expire messages in outboxes."""
    for peer, held in state.outboxes.expire(now):
        _drop_held(state, peer, held, ExpiryReason.DEADLINE)
