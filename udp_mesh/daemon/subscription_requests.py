"""The requests `subscribe`, `unsubscribe` and `subscriptions` of the local API (docs/local-api.md)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from udp_mesh.client.mesh_client import Header
from udp_mesh.core.subscriptions.messages import MAX_AGE_S, MAX_RATE_HZ, MIN_AGE_S, MIN_RATE_HZ, Bounds
from udp_mesh.daemon.api import Client, RequestError
from udp_mesh.daemon.status import subscriptions_json
from udp_mesh.wire.limits import MAX_TOPIC_BYTES

if TYPE_CHECKING:
    from udp_mesh.daemon.service import Service


def subscribe(service: Service, client: Client, header: Header, _: bytes) -> Header:
    """`topics`; optional `rate_hz` and `max_age_s`, which bound each of them, and `acknowledge`."""
    patterns = _texts(header, "topics")
    bounds = Bounds(
        _number(header, "rate_hz", MIN_RATE_HZ, MAX_RATE_HZ, "messages a second"),
        _number(header, "max_age_s", MIN_AGE_S, MAX_AGE_S, "seconds"),
    )
    for pattern in patterns:
        # Peers would refuse the whole table.
        if not pattern.isprintable() or not 1 <= len(pattern.encode()) <= MAX_TOPIC_BYTES:
            raise RequestError(
                "bad-request",
                f"topics: expected patterns of 1 to {MAX_TOPIC_BYTES} printable bytes, found {pattern[:80]!r}",
            )
    service.subscriptions.add(client, patterns, bounds, acknowledge=bool(header.get("acknowledge")))
    return {}


def unsubscribe(service: Service, client: Client, header: Header, _: bytes) -> Header:
    service.subscriptions.remove(client, _texts(header, "topics"))
    return {}


def subscriptions(service: Service, _client: Client, _header: Header, _: bytes) -> Header:
    """What programs read here and at each peer, and what peers were therefore not sent."""
    return dict(subscriptions_json(service.driver.node.selective.conditions(), service.subscriptions.read_here()))


def _texts(header: Header, key: str) -> list[str]:
    value = header.get(key)
    if not isinstance(value, list) or not all(isinstance(item, str) for item in value):
        raise RequestError("bad-request", f"{key}: expected a list of strings, found {value!r}")
    return value


def _number(header: Header, key: str, low: float, high: float, unit: str) -> float | None:
    value = header.get(key)
    if value is None:
        return None
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if not is_number or not low <= value <= high:
        raise RequestError(
            "bad-request", f"{key}: expected a number of {unit} from {low:g} to {high:g}, found {repr(value)[:80]}"
        )
    return float(value)
