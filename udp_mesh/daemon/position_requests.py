"""The requests `set-position`, `publish-meter` and `set-radio` of the local API (docs/local-api.md)."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from udp_mesh.client.mesh_client import Header
from udp_mesh.daemon.api import Client, RequestError
from udp_mesh.daemon.interface import METER_TOPIC
from udp_mesh.daemon.positions import (
    DEFAULT_FRAME,
    MAX_AGE_S,
    MAX_COORDINATE_M,
    MAX_FRAME_BYTES,
    Position,
    PositionSource,
    is_coordinate,
    is_frame,
)
from udp_mesh.daemon.radio_paths import BadReport, parse_report

if TYPE_CHECKING:
    from udp_mesh.daemon.service import Service


def set_position(service: Service, _client: Client, header: Header, _: bytes) -> Header:
    """`x_m`, `y_m`; optional `z_m`, `frame`, and `time_s`, the Unix time of the measurement."""
    x_m, y_m, z_m = _meters(header, "x_m"), _meters(header, "y_m"), None
    if header.get("z_m") is not None:
        z_m = _meters(header, "z_m")
    frame = header.get("frame", DEFAULT_FRAME)
    if not isinstance(frame, str) or not is_frame(frame):
        raise RequestError(
            "bad-request",
            f"frame: expected a name of 1 to {MAX_FRAME_BYTES} bytes without spaces, found {str(frame)[:80]!r}",
        )
    age_s = 0.0
    if header.get("time_s") is not None:
        # The program's clock is this machine's; a time ahead of it is a simulation's, and counts as now.
        age_s = min(max(0.0, service.wall_clock() - _number(header, "time_s", "a Unix time in seconds")), MAX_AGE_S)
    service.positions.set_own(Position(x_m, y_m, z_m, frame, service.driver.now() - age_s, PositionSource.API))
    return {}


def _meters(header: Header, key: str) -> float:
    value = _number(header, key, "a number of meters")
    if not is_coordinate(value):
        limit = f"{MAX_COORDINATE_M:g}"
        raise RequestError(
            "bad-request", f"{key}: expected a number of meters from -{limit} to {limit}, found {value!r}"
        )
    return value


def _number(header: Header, key: str, expected: str) -> float:
    value = header.get(key)
    try:
        number = float(value) if isinstance(value, int | float) and not isinstance(value, bool) else math.nan
    except OverflowError:
        # JSON's integers have no limit.
        number = math.inf
    if not math.isfinite(number):
        raise RequestError("bad-request", f"{key}: expected {expected}, found {repr(value)[:80]}")
    return number


def publish_meter(service: Service, _client: Client, _header: Header, payload: bytes) -> Header:
    """Passes a reading of the placement meter to the local subscribers of its topic."""
    header: Header = {"event": "message", "source": service.settings.name, "topic": METER_TOPIC}
    clients = list(service.subscriptions.subscribed_literally(METER_TOPIC))
    for client in clients:
        client.send_event({**header, "type": "application/json", "priority": 15, "broadcast": False}, payload)
    return {"subscribers": len(clients)}


def set_radio(service: Service, _client: Client, _header: Header, payload: bytes) -> Header:
    """A collector's report of the robot's radio, instead of the one before."""
    try:
        service.radio = parse_report(payload, service.driver.now())
    except BadReport as error:
        raise RequestError("bad-request", str(error)) from error
    return {}
