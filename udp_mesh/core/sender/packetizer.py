"""Builds the datagrams for one peer at the last moment: level -> fragments -> frames -> sealed datagrams.

`send_level` sends from one priority level until it is empty or the window, pacing or batch size is exhausted. A run of
full fragments of one message takes the fast path: one pack, one seal and one record per fragment. Everything else
(first and last fragments, small messages, retransmissions) is built frame by frame, with small fragments sharing a
datagram.
"""

from udp_mesh.core.events import ExpiryReason
from udp_mesh.core.interfaces import Datagram
from udp_mesh.core.sender.message import OutgoingMessage
from udp_mesh.core.sender.path import IP_UDP_BYTES, Path
from udp_mesh.core.sender.pending import Outcome
from udp_mesh.core.sender.rate_limit import TokenBucket
from udp_mesh.core.sender.scheduler import Run
from udp_mesh.core.sender.send_quota import (
    ack_spacing,
    cwnd_room,
    next_send_at,
    pack_until,
    send_quota,
    urgent_wait_until,
)
from udp_mesh.core.sender.send_state import SendState
from udp_mesh.core.sender.sender import Sender
from udp_mesh.core.sender.sent_packets import Packet, SendSnapshot
from udp_mesh.wire.codec import ANNOUNCE_BYTES, encode
from udp_mesh.wire.fragment import (
    COMPACT_BYTES,
    FRAGMENT,
    FRAGMENT_ACK_NOW,
    FRAGMENT_BYTES,
    FRAGMENT_WIDE,
    FRAGMENT_WIDE_BYTES,
    HEAD_BYTES,
    LENGTH_BYTES,
    LIFE_BYTES,
    MAX_COMPACT_AGE_MS,
    NARROW_HEADER,
    WIDE_FROM,
    WIDE_HEADER,
)
from udp_mesh.wire.frames import (
    Delivered,
    Fragment,
    Frame,
    MessageFlag,
    MessageHead,
    Payload,
    Ping,
    TopicAnnounce,
)
from udp_mesh.wire.limits import MAX_FRAMES_PER_DATAGRAM, MAX_IDS

MIN_ROOM_BYTES = 64
"""With less room than this in a datagram, no further small message is added."""

PING_BYTES = 9
DELIVERED_BYTES = 4
ID_BYTES = 4
"""Sizes of a PING, of a DELIVERED without its message ids, and of one message id."""

NO_MESSAGE_ID = 0xFFFF_FFFF
"""Messages are numbered from 0; no boot lives long enough to use this number."""


def send_level(
    sender: Sender,
    path: Path,
    priority: int,
    now: float,
    out: list[Datagram],
    room_bytes: int,
    rate_limits: dict[str, TokenBucket],
) -> int:
    """Send what waits on one level, at most about `room_bytes`. Returns the bytes sent."""
    urgent_level = priority <= sender.rates.urgent_priority
    level_pace = sender.congestion.pacing_packets_per_s()
    used = 0
    snapshot = sender.snapshot(now, urgent=urgent_level)
    while used < room_bytes:
        run = sender.scheduler.peek(priority)
        if run is None:
            break
        if not urgent_level and (shared_at := pack_until(sender, priority, path.room_bytes, now)) > now:
            sender.wake_at = min(sender.wake_at, shared_at)
            sender.packing.waiting |= 1 << priority
            break
        urgent = urgent_level and not run.stale
        pace = None if urgent else level_pace
        room = cwnd_room(sender, now)
        quota = send_quota(sender, room, now, pace, urgent=urgent)
        if quota <= 0:
            sender.app_limited = False
            if urgent:
                if sender.state is not SendState.UNRESPONSIVE:
                    sender.wake_at = min(sender.wake_at, urgent_wait_until(sender))
            elif (next_at := next_send_at(sender, room, now, pace)) is not None:
                sender.wake_at = min(sender.wake_at, next_at)
            break
        message = run.message
        if message.superseded and run.retransmit:
            sender.finish(message, ExpiryReason.SUPERSEDED)
            continue
        bucket = rate_limits.get(message.accepted.channel.name) if rate_limits else None
        if bucket is not None and bucket.must_wait(sender, run, now):
            sender.scheduler.park_head(run)
            bucket.park(sender, run)
            continue
        if not message.started:
            version = message.version
            if version is not None and not version.prepared:
                sender.scheduler.park_head(run)
                if version.prepare(message, sender.epoch, accepted=path.versions, now=now):
                    sender.scheduler.restore(message)
                continue
            _begin(sender, path, message)
            run = Run(message, 0, message.fragments, retransmit=False, stale=run.stale)
        before = used
        is_plain = bucket is None and message.accepted.broadcast_number is None
        if run.position and run.length > 2 and quota > 1 and is_plain:
            count = min(run.length - 1, quota, 1 + (room_bytes - used) // message.fragment_bytes)
            used += _send_run(sender, path, run, count, snapshot, out)
        else:
            count = 1
            used += _send_datagram(sender, path, run, urgent, snapshot, out)
        if bucket is not None:
            bucket.consume(used - before, sender)
        if sender.probing.credit:
            sender.probing.credit = max(0, sender.probing.credit - count)
        if urgent:
            sender.urgent_sent_at = now
        else:
            sender.pacer.on_sent(count, now, pace)
    return used


def send_copies(sender: Sender, path: Path, now: float, out: list[Datagram]) -> None:
    """Send the redundant copies that are due and not acknowledged meanwhile."""
    for message, position in sender.copies.pop_due(now, sender.urgent_timeout_s()):
        if sender.state is SendState.UNRESPONSIVE:
            continue
        run = Run(message, position, 1, retransmit=True)
        _seal_datagram(
            sender,
            path,
            [(message, position)],
            [*_frames(sender, path, run, now, ack_now=True)],
            sender.snapshot(now, urgent=True)._replace(copy=True),
            out,
        )


def build_mtu_probe(sender: Sender, path: Path, token: int, frames_bytes: int) -> Datagram:
    """A ping padded to at least `frames_bytes` of frames, and at most 7 B more.

    The padding is DELIVERED frames for a message id that is never used.
    """
    frames: list[Frame] = [Ping(token)]
    missing = frames_bytes - PING_BYTES
    while missing > 0:
        ids = min(MAX_IDS, max(1, -(-(missing - DELIVERED_BYTES) // ID_BYTES)))
        frames.append(Delivered((NO_MESSAGE_ID,) * ids))
        missing -= DELIVERED_BYTES + ID_BYTES * ids
    number, data = path.seal(encode(frames))
    sender.in_flight.add(number, None)
    return Datagram(path.link, path.address, data, True)


def _begin(sender: Sender, path: Path, message: OutgoingMessage) -> None:
    channel = message.accepted.channel
    first = path.fragment_bytes - HEAD_BYTES
    if channel.number not in sender.announced:
        first -= ANNOUNCE_BYTES + len(channel.name.encode()) + len(channel.type_name.encode())
        first -= LENGTH_BYTES
    broadcast_number = message.accepted.broadcast_number
    if broadcast_number is not None:
        # The repair of a lost broadcast keeps its number; otherwise the receiver would take it for another message.
        message.begin(broadcast_number, path.fragment_bytes, max(1, first))
        return
    message.begin(sender.next_wire_id, path.fragment_bytes, max(1, first))
    message.confirm = path.confirms and message.reliable and message.accepted.channel.topic.keeps_on_disk
    sender.next_wire_id += 1


def _send_run(sender: Sender, path: Path, run: Run, count: int, snapshot: SendSnapshot, out: list[Datagram]) -> int:
    """The fast path: send `count` consecutive full fragments, excluding a message's first and last."""
    message, position = run.message, run.position
    wire_id = message.wire_id
    assert wire_id is not None
    size = message.fragment_bytes
    offset = message.first_bytes + (position - 1) * size
    body = memoryview(message.body)
    frames = []
    spacing = ack_spacing(sender)
    since = sender.since_ack_requested
    wide = position + count > WIDE_FROM
    pack = WIDE_HEADER.pack if wide else NARROW_HEADER.pack
    plain = FRAGMENT | FRAGMENT_WIDE if wide else FRAGMENT
    if wide and position < WIDE_FROM:
        count = WIDE_FROM - position
        pack, plain = NARROW_HEADER.pack, FRAGMENT
    for place in range(position, position + count):
        since += 1
        first = plain
        if since >= spacing:
            since = 0
            first |= FRAGMENT_ACK_NOW
        frames.append(pack(first, wire_id, place) + body[offset : offset + size])
        offset += size
    number = path.channel.next_number
    out.extend(Datagram.run(path.link, path.address, path.seal_run(frames)))
    sender.in_flight.add_run(number, snapshot, message, range(position, position + count))
    sender.since_ack_requested = since
    sent_bytes = count * (size + FRAGMENT_BYTES + path.overhead_bytes)
    sender.sent_packets += count
    sender.sent_bytes += sent_bytes + IP_UDP_BYTES * count
    sender.scheduler.consume(run, count)
    return sent_bytes


def _send_datagram(
    sender: Sender, path: Path, run: Run, urgent: bool, snapshot: SendSnapshot, out: list[Datagram]
) -> int:
    """Send one datagram with the fragment of `run` and, if there is room, the next small fragments of the same
    level."""
    now = snapshot.sent_at
    message = run.message
    fragments: list[tuple[OutgoingMessage, int]] = []
    frames: list[Frame] = []
    room = path.room_bytes
    priority = message.priority
    scheduler = sender.scheduler
    retransmitted = 0
    spacing = ack_spacing(sender)
    sender.since_ack_requested += 1
    next_run: Run | None = run
    size = _fragment_frame_bytes(sender, path, run, now)
    while next_run is not None:
        message = next_run.message
        if next_run.retransmit and (message, next_run.position) in fragments:
            # Several copies of it were lost; one datagram needs only one.
            scheduler.consume(next_run, 1)
            next_run, size = _next_small(sender, path, priority, room, now)
            continue
        if frames and (size > room or len(frames) >= MAX_FRAMES_PER_DATAGRAM - 3):
            break
        retransmitted += next_run.retransmit
        fragments.append((message, next_run.position))
        scheduler.consume(next_run, 1)
        last = next_run.position == message.fragments - 1
        ack_now = urgent or sender.since_ack_requested >= spacing
        if not ack_now and last and scheduler.is_idle(priority):
            ack_now = now >= sender.ack_requested_at + sender.rates.ack_delay_s
        frames.extend(_frames(sender, path, next_run, now, ack_now=ack_now))
        if ack_now:
            sender.since_ack_requested = 0
            sender.ack_requested_at = now
        room -= size
        if urgent and message.small and not next_run.retransmit:
            sender.schedule_copies(message, next_run.position, now)
        if not message.reliable and last:
            sender.finish(message, Outcome.SENT)
        if room < MIN_ROOM_BYTES:
            break
        next_run, size = _next_small(sender, path, priority, room, now)
    sender.retransmitted += retransmitted
    if not urgent:
        sender.packing.on_sent(len(fragments), has_room=room > path.room_bytes // 2, now=now)
    return _seal_datagram(sender, path, fragments, frames, snapshot, out, urgent=urgent)


def _seal_datagram(
    sender: Sender,
    path: Path,
    fragments: list[tuple[OutgoingMessage, int]],
    frames: list[Frame],
    snapshot: SendSnapshot,
    out: list[Datagram],
    *,
    urgent: bool = True,
) -> int:
    number, data = path.seal(path.encode(frames, snapshot.sent_at))
    (message, position), *more = fragments
    sender.in_flight.add(number, Packet(snapshot, message, position, tuple(more)))
    out.append(Datagram(path.link, path.address, data, urgent))
    sender.sent_packets += 1
    sender.sent_bytes += len(data) + IP_UDP_BYTES
    return len(data)


def _next_small(sender: Sender, path: Path, priority: int, room: int, now: float) -> tuple[Run | None, int]:
    """The next fragment of the level and the size of its frames, if it is small enough to share the datagram and needs
    no decision of the main loop."""
    run = sender.scheduler.peek(priority)
    if run is None or run.message.superseded or run.message.accepted.channel.topic.rate_limit_bytes_per_s is not None:
        return None, 0
    if not run.message.started:
        version = run.message.version
        if len(run.message.body) > room or (version is not None and not version.prepared):
            return None, 0
        _begin(sender, path, run.message)
        if run.message.fragments > 1:
            run = Run(run.message, 0, run.message.fragments, retransmit=False, stale=run.stale)
    size = _fragment_frame_bytes(sender, path, run, now)
    return (run, size) if size <= room else (None, 0)


def _fragment_frame_bytes(sender: Sender, path: Path, run: Run, now: float) -> int:
    """Size of the frames that carry one fragment, at most."""
    message = run.message
    if run.position:
        start, end = message.span(run.position)
        return end - start + LENGTH_BYTES + FRAGMENT_WIDE_BYTES
    size = message.first_bytes + LENGTH_BYTES
    channel = message.accepted.channel
    if path.compact and message.fragments == 1 and (now - message.accepted.accepted_at) * 1000 <= MAX_COMPACT_AGE_MS:
        size += COMPACT_BYTES
    else:
        size += FRAGMENT_BYTES + HEAD_BYTES
    if _sends_life(path, message):
        size += LIFE_BYTES
    if channel.number not in sender.announced:
        size += ANNOUNCE_BYTES + len(channel.name.encode()) + len(channel.type_name.encode())
    return size


def _sends_life(path: Path, message: OutgoingMessage) -> bool:
    return path.timed and path.confirmed and message.accepted.deadline is not None


def _frames(sender: Sender, path: Path, run: Run, now: float, *, ack_now: bool) -> list[Frame]:
    """The frames of one fragment: the first carries the head and, until the peer knows the topic, its announcement."""
    message, position = run.message, run.position
    accepted = message.accepted
    wire_id = message.wire_id
    assert wire_id is not None
    is_broadcast = accepted.broadcast_number is not None
    payload: Payload = message.body
    if message.fragments > 1:
        start, end = message.span(position)
        payload = memoryview(payload)[start:end]
    if position:
        return [Fragment(wire_id, position, payload, None, ack_now, is_broadcast)]
    head = MessageHead(
        len(message.body),
        message.fragments,
        accepted.channel.number,
        message.priority,
        message.flags | MessageFlag.CONFIRM if message.confirm else message.flags,
        max(0, int((now - accepted.accepted_at) * 1000)),
        accepted.life_ms(now) if _sends_life(path, message) else None,
    )
    fragment = Fragment(wire_id, 0, payload, head, ack_now, is_broadcast)
    channel = accepted.channel
    if channel.number in sender.announced:
        return [fragment]
    return [TopicAnnounce(channel.number, channel.name, channel.type_name), fragment]
