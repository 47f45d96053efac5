"""Changes of a running node: links come and go, settings are replaced, outboxes are restored, the node closes.

No accepted message is dropped: a topic's new settings apply to messages already waiting.
"""

from dataclasses import fields, replace
from enum import Enum

from udp_mesh.core.events import ExpiryReason, MessageId
from udp_mesh.core.interfaces import Datagram
from udp_mesh.core.path_mtu import update_mtu
from udp_mesh.core.peers.heartbeat import uses_link
from udp_mesh.core.publish import enqueue, flush_compression, report_ended, report_expired, topic_channel
from udp_mesh.core.sender.message import AcceptedMessage
from udp_mesh.core.sender.rate_limit import TokenBucket
from udp_mesh.core.settings import RELAY_LINK, LinkInfo, LinkKind, Neighbour, RelaySettings, Settings, Topic
from udp_mesh.core.state import State, live_keys
from udp_mesh.crypto import SendChannel
from udp_mesh.wire.codec import encode
from udp_mesh.wire.frames import Bye, MessageFlag


def restore_outboxes(state: State, now: float) -> None:
    """Queue the messages that the last run left on disk."""
    for stored in state.outboxes.load():
        topic = state.named_topic(stored.topic)
        channel = topic_channel(state, topic, stored.type_name) if topic is not None else None
        if channel is None:
            # Its topic is no longer declared: it stays on disk for a run that declares it.
            continue
        message_id = MessageId(state.next_message_id)
        state.next_message_id += 1
        flags = MessageFlag.RELIABLE if channel.topic.reliable else 0
        deadline = None if stored.remaining_s is None else now + stored.remaining_s
        accepted = AcceptedMessage(message_id, channel, stored.payload, stored.payload, flags, now, deadline)
        enqueue(state, stored.peer, accepted, now, stored.key)


def link_up(state: State, link: LinkInfo, now: float) -> None:
    """Add or change a link; a heartbeat follows soon."""
    state.links[link.name] = link
    for session in state.peer_table.sessions.values():
        if session.path.link == link.name:
            update_mtu(state, session, link.mtu)
    state.heartbeats.schedule_now(len(state.peer_table.sessions), now)


def link_down(state: State, name: str) -> None:
    """Remove a link. Peers keep their last path until they are heard on another link."""
    state.links.pop(name, None)


def apply(state: State, settings: Settings, now: float) -> list[str]:
    """See `Endpoint.apply`."""
    old = state.settings
    if (settings.name, settings.port) != (old.name, old.port):
        raise ValueError("name and port cannot change at run time; restart the node")
    changes = _changes(old, settings)
    state.settings = settings
    state.topics = {topic.name: topic for topic in settings.topics}
    state.event_queue.set_limit(settings.limits.events)
    state.peer_table.apply(settings)
    state.versions.limit_bytes = settings.limits.version_bytes
    state.priority_backoff.apply(settings.rates)
    _retopic(state, now)
    keys = live_keys(settings)
    if keys != state.keys:
        state.keys = keys
        number = state.broadcast_channel.next_number
        state.broadcast_channel = SendChannel(keys[0], state.boot_id)
        state.broadcast_channel.next_number = number
        state.peer_table.set_keys(keys)
    for session in state.peer_table.sessions.values():
        session.receiver.apply(settings.rates, settings.limits)
    for peer in state.peer_table.peers.values():
        peer.apply(settings)
        if peer.sender is not None:
            state.ready[peer] = None
        state.arm(peer)
    for session in state.peer_table.sessions.values():
        info = state.links.get(session.path.link)
        if info is not None:
            update_mtu(state, session, info.mtu)
    state.heartbeats.schedule_now(len(state.peer_table.sessions), now)
    return changes


def _changes(old: Settings, new: Settings) -> list[str]:
    """One line per change, for the operator."""
    lines = []
    before = {topic.name: topic for topic in old.topics}
    after = {topic.name: topic for topic in new.topics}
    lines += [f"topic {name}: added" for name in after if name not in before]
    lines += [f"topic {name}: removed" for name in before if name not in after]
    for name in sorted(before.keys() & after.keys()):
        lines += [f"topic {name}: {text}" for text in _differences(before[name], after[name])]
    if old.keys != new.keys:
        lines.append("keys: changed")
    lines += _relay(old.relay, new.relay)
    for what in ("rates", "limits"):
        lines += [f"{what}: {text}" for text in _differences(getattr(old, what), getattr(new, what))]
    lines += _topic_without_name(old.undeclared, new.undeclared)
    lines += _neighbours(old.neighbours, new.neighbours)
    for what in ("window", "fragment_bytes", "selective"):
        if getattr(old, what) != getattr(new, what):
            lines.append(f"{what}: {_shown(getattr(old, what))} -> {_shown(getattr(new, what))}")
    return lines


def _topic_without_name(old: Topic | None, new: Topic | None) -> list[str]:
    if old is None or new is None:
        return [] if old is new else ["undeclared: removed" if new is None else "undeclared: added"]
    return [f"undeclared: {text}" for text in _differences(old, new)]


def _neighbours(old: tuple[Neighbour, ...], new: tuple[Neighbour, ...]) -> list[str]:
    before = {neighbour.address: neighbour for neighbour in old}
    after = {neighbour.address: neighbour for neighbour in new}
    return [
        *(f"neighbor {address[0]}: added" for address in after if address not in before),
        *(f"neighbor {address[0]}: removed" for address in before if address not in after),
        *(
            f"neighbor {address[0]}: {text}"
            for address in before.keys() & after.keys()
            for text in _differences(before[address], after[address])
        ),
    ]


def _relay(old: RelaySettings, new: RelaySettings) -> list[str]:
    lines = [f"relay: {text}" for text in _differences(replace(old, keys=()), replace(new, keys=()))]
    return [*lines, "relay: keys changed"] if old.keys != new.keys else lines


def _differences(old: object, new: object) -> list[str]:
    texts = []
    for field in fields(old):  # type: ignore[arg-type]
        before, after = getattr(old, field.name), getattr(new, field.name)
        if before != after:
            texts.append(f"{field.name} {_shown(before)} -> {_shown(after)}")
    return texts


def _shown(value: object) -> str:
    """The value as written in the configuration."""
    match value:
        case None:
            return "none"
        case bool():
            return str(value).lower()
        case Enum():
            return str(value.value)
        case tuple():
            return f"[{', '.join(map(str, value))}]"
        case _:
            return str(value)


def _retopic(state: State, now: float) -> None:
    """Apply the new settings to every topic; waiting messages move to the new priority."""
    for channel in state.channels.values():
        topic = state.named_topic(channel.name)
        if topic is not None:
            channel.topic = topic
    for name in list(state.rate_limits):
        limited = state.named_topic(name)
        rate = None if limited is None else limited.rate_limit_bytes_per_s
        bucket = state.rate_limits[name]
        bucket.unpark_all()
        if rate is None:
            del state.rate_limits[name]
        else:
            bucket.bytes_per_s = rate
    for topic in state.topics.values():
        if topic.rate_limit_bytes_per_s is not None and topic.name not in state.rate_limits:
            state.rate_limits[topic.name] = TokenBucket(topic.rate_limit_bytes_per_s, now)
    for peer in state.peer_table.peers.values():
        if peer.sender is not None:
            peer.sender.reprioritize()
    state.broadcasts.reprioritize()


def close(state: State, now: float) -> None:
    """See `Endpoint.close`."""
    if state.closed:
        return
    flush_compression(state, now)
    state.selection.close()
    for peer in state.peer_table.peers.values():
        sender = peer.sender
        if sender is None:
            continue
        for message in list(sender.pending):
            if state.outboxes.on_disk(message.store_key):
                sender.withdraw(message)
            else:
                sender.finish(message, ExpiryReason.CLOSED)
        report_ended(state, peer, now)
    for name, held in state.outboxes.drop_all():
        report_expired(state, name, held.accepted, ExpiryReason.CLOSED)
    links = state.own_links()
    for target in state.relay_targets.values():
        _, data = state.broadcast_channel.seal_long(encode([Bye("closed")]))
        state.outgoing.append(Datagram(RELAY_LINK, target.address, data, True))
    for link in links:
        _, data = state.broadcast_channel.seal_long(encode([Bye("closed")]))
        if link.kind is LinkKind.BROADCAST:
            state.outgoing.append(Datagram(link.name, link.broadcast, data, True))
        for neighbour in state.settings.neighbours:
            if not neighbour.legacy and uses_link(neighbour, link, links):
                state.outgoing.append(Datagram(link.name, neighbour.address, data, True))
    state.ready.clear()
    state.closed = True
