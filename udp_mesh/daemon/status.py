"""The daemon's state as JSON values: conditions -> peers, events -> dictionaries, settings -> topics. Pure.

Times on the core's clock become ages ("heard_ago_s"), since no reader shares that clock.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterable, Mapping
from enum import Enum
from pathlib import Path

from udp_mesh.core.conditions import Conditions, PeerConditions
from udp_mesh.core.events import Event
from udp_mesh.core.logs.conditions import LogConditions
from udp_mesh.core.relaying.conditions import RelayConditions
from udp_mesh.core.settings import Address, Settings, Topic
from udp_mesh.core.subscriptions.conditions import SubscriptionConditions
from udp_mesh.core.subscriptions.messages import Bounds, Subscription
from udp_mesh.core.thin.conditions import ThinConditions
from udp_mesh.core.versions.conditions import VersionConditions
from udp_mesh.daemon.interface import RESERVED_PREFIX

Json = dict[str, object]


def show_address(address: Address | None) -> str | None:
    """`10.0.0.2:8700` or `[fd00::2]:8700`."""
    if address is None:
        return None
    host, port = address
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def plain(value: object) -> object:
    """A value as JSON: dataclasses as objects, enums as their values, addresses as text, bytes as hex."""
    match value:
        case Enum():
            return value.value
        case Path():
            return str(value)
        case bytes() | bytearray() | memoryview():
            return bytes(value).hex()
        case float():
            return round(value, 6)
        case (str() as host, int() as port):
            return show_address((host, port))
        case tuple() | list():
            return [plain(item) for item in value]
        case dict():
            return {str(key): plain(item) for key, item in value.items()}
        case _ if dataclasses.is_dataclass(value) and not isinstance(value, type):
            return {item.name: plain(getattr(value, item.name)) for item in dataclasses.fields(value)}
        case _:
            return value


def event_name(event: Event) -> str:
    """`peer-online` for `PeerOnline`."""
    return re.sub(r"(?<!^)(?=[A-Z])", "-", type(event).__name__).lower()


def event_json(event: Event) -> Json:
    """An event's fields and its name; of a received message's payload only the size."""
    fields: Json = {"event": event_name(event)}
    for item in dataclasses.fields(event):
        value = getattr(event, item.name)
        if isinstance(value, bytes):
            fields["bytes"] = len(value)
        else:
            fields[item.name] = plain(value)
    return fields


def peer_json(peer: PeerConditions, now: float) -> Json:
    """One peer's conditions."""
    fields = plain(peer)
    assert isinstance(fields, dict)
    online_since, last_heard = fields.pop("online_since"), fields.pop("last_heard")
    fields["online_for_s"] = None if online_since is None or not peer.online else round(now - online_since, 3)
    fields["heard_ago_s"] = None if last_heard is None else round(now - last_heard, 3)
    return fields


def conditions_json(conditions: Conditions) -> Json:
    """All peers and the node's counters."""
    return {
        "name": conditions.name,
        "peers": [peer_json(peer, conditions.now) for peer in conditions.peers],
        "counters": plain(conditions.counters),
        "sent_bits_per_s": round(conditions.sent_bits_per_s, 1),
        "heard_bits_per_s": round(conditions.heard_bits_per_s, 1),
        "partial_bytes": conditions.partial_bytes,
        "queued_bytes": conditions.queued_bytes,
        "repair_bytes": conditions.repair_bytes,
        "strangers": [
            {
                "name": stranger.name,
                "address": show_address(stranger.address),
                "link": stranger.link,
                "heard_for_s": round(conditions.now - stranger.met_at, 3),
                "heard_ago_s": round(conditions.now - stranger.last_heard, 3),
            }
            for stranger in conditions.strangers
        ],
    }


def log_json(log: LogConditions) -> Json:
    """One shared log as this node sees it."""
    fields = plain(log)
    assert isinstance(fields, dict)
    fields["missing_readers"] = dict(log.missing_readers)
    return fields


def subscriptions_json(conditions: SubscriptionConditions, here: Iterable[Subscription]) -> Json:
    """What programs read `here` and at each peer (null: everything), and what was saved."""
    return {
        "selective": conditions.selective,
        "read_here": _subscriptions(dict(here)),
        "announced": None if conditions.own is None else _subscriptions(dict(conditions.own)),
        "peers": [
            {
                "name": peer.name,
                "known": peer.known,
                "reads": None if peer.subscriptions is None else _subscriptions(dict(peer.subscriptions)),
                "saved": plain(peer.saved),
            }
            for peer in conditions.peers
        ],
        "broadcasts_saved": plain(conditions.broadcasts),
    }


def _subscriptions(by_pattern: Mapping[str, Bounds]) -> list[Json]:
    return [{"topics": pattern, **bounds._asdict()} for pattern, bounds in sorted(by_pattern.items())]


def relaying_json(relaying: RelayConditions) -> Json:
    """Relays as this node sees them."""
    fields = plain(relaying)
    assert isinstance(fields, dict)
    return fields


def thin_json(
    thin: ThinConditions | None, failures: Mapping[str, str], refusals: Mapping[str, str] | None = None
) -> Json | None:
    """Thin links as this node sees them (None: it has none); `failures` says why ports are not open, `refusals` why
    radios do not send."""
    if thin is None:
        return None
    fields = plain(thin)
    assert isinstance(fields, dict)
    return {**fields, "failures": dict(failures), "refusals": dict(refusals or {})}


@dataclasses.dataclass(slots=True)
class TopicCount:
    """Counters of one topic."""

    sent_messages: int = 0
    sent_bytes: int = 0
    received_messages: int = 0
    received_bytes: int = 0
    last_sent: float | None = None
    """On the core's clock, like `last_received`; None before the first message."""
    last_received: float | None = None


def topic_json(topic: Topic) -> Json:
    fields = plain(topic)
    assert isinstance(fields, dict)
    return fields


def topics_json(
    settings: Settings, counts: Mapping[str, TopicCount], now: float, versions: Iterable[VersionConditions] = ()
) -> list[Json]:
    """Configured topics by priority, then topics that were only received; each with its counters and the age of its
    last message in each direction, and what was saved by differences."""
    differences = {entry.topic: dataclasses.asdict(entry.counters) for entry in versions}
    configured = [topic for topic in settings.topics if not topic.name.startswith(RESERVED_PREFIX)]
    rows = [
        {**topic_json(topic), "configured": True, **_count_json(counts.get(topic.name, TopicCount()), now)}
        for topic in sorted(configured, key=lambda topic: (topic.priority, topic.name))
    ]
    known = {topic.name for topic in configured}
    rows += [
        {"name": name, "configured": False, **_count_json(count, now)}
        for name, count in sorted(counts.items())
        if name not in known and not name.startswith(RESERVED_PREFIX)
    ]
    for row in rows:
        row["versions"] = differences.get(str(row["name"]))
    return rows


def _count_json(count: TopicCount, now: float) -> Json:
    fields: Json = dataclasses.asdict(count)
    for key, at in (("sent_ago_s", count.last_sent), ("received_ago_s", count.last_received)):
        fields[key] = None if at is None else round(now - at, 3)
    del fields["last_sent"], fields["last_received"]
    return fields
