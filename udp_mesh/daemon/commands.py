"""The requests of the local API: each a function of the service, the client, the header's fields and the payload.

A command returns the reply's fields or an awaitable for them; it raises RequestError to refuse. docs/local-api.md lists
every request with its reply.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Awaitable, Callable
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

from udp_mesh import __version__
from udp_mesh.client.mesh_client import Header
from udp_mesh.core.setting_checks import is_type_name
from udp_mesh.core.settings import Settings
from udp_mesh.daemon import metrics
from udp_mesh.daemon.api import Client, RequestError
from udp_mesh.daemon.configuration import load, read_keys, read_rates
from udp_mesh.daemon.file_access import FILE_TIMEOUT_S, is_below, off_loop
from udp_mesh.daemon.interface import CONDITIONS_TOPIC, MAX_PING_S, RESERVED_PREFIX
from udp_mesh.daemon.neighbours import (
    NODE_NAME,
    TOPIC_NAME,
    is_node_name,
    is_topic_name,
    parse_address,
    read_neighbour,
)
from udp_mesh.daemon.outcomes import Publisher
from udp_mesh.daemon.position_requests import publish_meter, set_position, set_radio
from udp_mesh.daemon.radio_paths import with_radio
from udp_mesh.daemon.service import Service
from udp_mesh.daemon.status import (
    conditions_json,
    log_json,
    plain,
    relaying_json,
    show_address,
    thin_json,
    topic_json,
    topics_json,
)
from udp_mesh.daemon.subscription_requests import subscribe, subscriptions, unsubscribe
from udp_mesh.daemon.toml_source import ConfigurationError, Source, Table
from udp_mesh.daemon.topic_settings import topic_from_values
from udp_mesh.wire.header import VERSION as WIRE_VERSION
from udp_mesh.wire.limits import MAX_TYPE_BYTES

MAX_NEIGHBOURS = 1024
"""Fixed neighbors, each of which gets every heartbeat; equal to the maximum number of peers."""
MAX_TOPICS = 4096
"""Topics declared by requests, so that a client cannot declare them without bound."""

Result = TypeVar("Result")

# Parse a request's fields


def _text(header: Header, key: str) -> str:
    value = header.get(key)
    if not isinstance(value, str) or not value:
        raise RequestError("bad-request", f"{key}: expected a non-empty string, found {value!r}")
    try:
        value.encode()
    except UnicodeEncodeError as error:
        # JSON can encode a lone surrogate, which is not valid Unicode.
        raise RequestError("bad-request", f"{key}: expected a valid Unicode string, found {value!r}") from error
    if "\0" in value:
        raise RequestError("bad-request", f"{key}: expected a string without NUL characters, found {value!r}")
    return value


def _optional_text(header: Header, key: str) -> str | None:
    return None if header.get(key) is None else _text(header, key)


def _values(header: Header, key: str) -> dict[str, object]:
    value = header.get(key, {})
    if not isinstance(value, dict):
        raise RequestError("bad-request", f"{key}: expected an object, found {value!r}")
    return value


def _request_error(error: ConfigurationError) -> RequestError:
    text = "; ".join(str(problem).removeprefix("command:1: ") for problem in error.problems)
    return RequestError("bad-configuration", text)


# Messages


def publish(service: Service, client: Client, header: Header, payload: bytes) -> Header | Awaitable[Header]:
    topic, destination = _text(header, "topic"), _optional_text(header, "to")
    publisher = Publisher(client, header.get("id")) if header.get("notify") else None
    type_name = _text(header, "type") if header.get("type") else ""
    # Refuse here, with a clear error, what every receiver would drop.
    if not is_topic_name(topic):
        raise RequestError("bad-request", f"topic: expected {TOPIC_NAME}, found {topic!r}")
    if destination is not None and not is_node_name(destination):
        raise RequestError("bad-request", f"to: expected {NODE_NAME}, found {destination!r}")
    if not is_type_name(type_name):
        raise RequestError(
            "bad-request", f"type: expected printable text of at most {MAX_TYPE_BYTES} bytes, found {type_name[:60]!r}"
        )
    message = service.publish(topic, payload, destination, type_name, publisher)
    if isinstance(message, int):
        if publisher is not None and (settings := service.topic(topic)) is not None and not settings.reliable:
            # No outcome will follow.
            return {"message": message, "reliable": False}
        return {"message": message}

    async def later() -> Header:
        return {"message": await message}

    return later()


def acknowledge(service: Service, client: Client, header: Header, _: bytes) -> Header:
    receipts = header.get("receipts")
    if not isinstance(receipts, list) or not all(isinstance(item, int) for item in receipts):
        raise RequestError("bad-request", f"receipts: expected a list of numbers, found {receipts!r}")
    return {"acknowledged": service.acknowledge(client, receipts)}


def events(service: Service, client: Client, _header: Header, _: bytes) -> Header:
    service.subscribe_events(client)
    return {}


def ping(service: Service, _client: Client, header: Header, _: bytes) -> Awaitable[Header]:
    peer, timeout_s = _text(header, "peer"), header.get("timeout_s", 2.0)
    if not isinstance(timeout_s, int | float) or not 0 < timeout_s <= MAX_PING_S:
        raise RequestError("bad-request", f"timeout_s: expected at most {MAX_PING_S:g}, found {timeout_s!r}")

    async def answer() -> Header:
        return {"round_trip_s": round(await service.pings.ping(peer, float(timeout_s)), 6)}

    return answer()


# Query


def status(service: Service, _client: Client, _header: Header, _: bytes) -> Header:
    settings, driver = service.settings, service.driver
    recorder = service.recorder
    return {
        "version": __version__,
        "wire_version": WIRE_VERSION,
        "boot": service.boot_id.hex(),
        "uptime_s": round(driver.now() - service.started, 3),
        "unkeyed": settings.unkeyed,
        "keys": [key.key_id.hex() for key in settings.keys],
        "window": settings.window,
        "inbox_messages": len(service.inbox),
        "configuration": plain(service.configuration.file),
        "links": [
            {
                "name": link.attachment.name,
                "device": link.attachment.device,
                "address": show_address(link.attachment.address),
                "broadcast": show_address(link.attachment.broadcast),
                "mtu": link.attachment.mtu,
                "segmentation_offload": link.segmentation,
                "lost_on_send": link.datagrams_lost_on_send,
            }
            for link in driver.hub.links.values()
        ],
        "refusals": [
            {
                "link": error.link,
                "to": error.to,
                "reason": error.reason,
                "datagrams": error.datagrams,
                "for_s": round(error.last - error.since, 3),
                "last_ago_s": round(driver.now() - error.last, 3),
            }
            for error in driver.output.send_errors.active()
        ],
        "link_failures": driver.link_failures,
        "recording": None if recorder is None else {"path": str(recorder.path), "bytes": recorder.bytes},
        "conditions": _conditions(service),
        "relaying": relaying_json(driver.node.relaying(driver.now())),
        "thin": thin_json(
            driver.node.thin_conditions(driver.now()), service.thin_ports.failures, service.thin_ports.refusals
        ),
        "positions": service.positions.json(),
    }


def _conditions(service: Service) -> Header:
    conditions = service.driver.conditions()
    return with_radio(conditions_json(conditions), service.radio, conditions.now)


def peers(service: Service, _client: Client, _header: Header, _: bytes) -> Header:
    return {"peers": _conditions(service)["peers"]}


def topics(service: Service, _client: Client, _header: Header, _: bytes) -> Header:
    undeclared = service.settings.undeclared
    return {
        "topics": topics_json(service.settings, service.counts, service.driver.now(), service.driver.node.versions()),
        "undeclared": None if undeclared is None else topic_json(undeclared),
    }


def logs(service: Service, _client: Client, _header: Header, _: bytes) -> Header:
    return {"logs": [log_json(log) for log in service.driver.node.logs()], "disk": service.log_store.problem}


def metrics_page(service: Service, client: Client, header: Header, _: bytes) -> None:
    client.reply(header.get("id"), render_metrics(service).encode())


def render_metrics(service: Service) -> str:
    """The metrics in Prometheus text format."""
    driver = service.driver
    relay_counters = dataclasses.asdict(driver.node.relaying(driver.now()).counters)
    extra = {
        "wakeups": driver.wakeups,
        **{f"relay_{name}": count for name, count in relay_counters.items()},
        "datagrams_lost_on_full_socket": driver.output.lost_on_full_socket,
        "datagrams_lost_on_send": sum(link.datagrams_lost_on_send for link in driver.hub.links.values()),
        "outbox_messages_refused_by_disk": service.store.refused,
        "log_items_refused_by_disk": service.log_store.refused,
    }
    visible = {name: count for name, count in service.counts.items() if not name.startswith(RESERVED_PREFIX)}
    about = {
        "name": service.settings.name,
        "version": __version__,
        "wire_version": str(WIRE_VERSION),
        "boot": service.boot_id.hex(),
    }
    return metrics.render(
        driver.conditions(),
        visible,
        extra,
        logs=driver.node.logs(),
        versions=driver.node.versions(),
        thin=driver.node.thin_conditions(driver.now()),
        about=about,
        uptime_s=driver.now() - service.started,
        latencies=service.latencies.by_priority,
        broadcasts_saved=driver.node.selective.conditions().broadcasts,
        radio=service.radio,
    )


# Change


def _changed(service: Service, settings: Settings) -> Header:
    return {"changes": service.apply(settings)}


def set_topic(service: Service, _client: Client, header: Header, _: bytes) -> Header:
    name, values = _text(header, "topic"), _values(header, "values")
    settings = service.settings
    current = next((topic for topic in settings.topics if topic.name == name), None)
    try:
        topic = topic_from_values(name, values, current)
    except ConfigurationError as error:
        raise _request_error(error) from error
    others = tuple(other for other in settings.topics if other.name != name)
    if len(others) >= MAX_TOPICS:
        raise RequestError("too-many", f"at most {MAX_TOPICS} topics may be declared")
    return _changed(service, replace(settings, topics=(*others, topic)))


def drop_topic(service: Service, _client: Client, header: Header, _: bytes) -> Header:
    name, settings = _text(header, "topic"), service.settings
    others = tuple(other for other in settings.topics if other.name != name)
    if name.startswith(RESERVED_PREFIX) or len(others) == len(settings.topics):
        raise RequestError("unknown-topic", f"topic {name!r} is not configured")
    return _changed(service, replace(settings, topics=others))


def set_window(service: Service, _client: Client, header: Header, _: bytes) -> Header:
    value = header.get("window")
    if value != "adaptive" and (not isinstance(value, int) or isinstance(value, bool) or not 1 <= value <= 4096):
        raise RequestError("bad-request", f'window: expected "adaptive" or 1 to 4096 packets, found {value!r}')
    return _changed(service, replace(service.settings, window=value))


def set_rates(service: Service, _client: Client, header: Header, _: bytes) -> Header:
    source = Source("command", {})
    rates = read_rates(Table(_values(header, "values"), source, ("rates",)), service.settings.rates)
    if source.problems:
        raise _request_error(ConfigurationError(source.problems))
    return _changed(service, replace(service.settings, rates=rates))


def set_neighbour(service: Service, _client: Client, header: Header, _: bytes) -> Header:
    settings, source = service.settings, Source("command", {})
    text, name, link = _text(header, "address"), _optional_text(header, "name"), _optional_text(header, "link")
    values = {"address": text, "name": name, "link": link, "legacy": bool(header.get("legacy"))}
    neighbour = read_neighbour(
        Table({key: value for key, value in values.items() if value is not None}, source, ("neighbor",)), settings.port
    )
    if neighbour is None:
        raise RequestError("bad-request", str(_request_error(ConfigurationError(source.problems))))
    others = tuple(other for other in settings.neighbours if other.address != neighbour.address)
    if len(others) >= MAX_NEIGHBOURS:
        raise RequestError("too-many", f"at most {MAX_NEIGHBOURS} neighbors may be configured")
    return _changed(service, replace(settings, neighbours=(*others, neighbour)))


def drop_neighbour(service: Service, _client: Client, header: Header, _: bytes) -> Header:
    text, settings = _text(header, "address"), service.settings
    address = parse_address(text, settings.port)
    others = tuple(other for other in settings.neighbours if other.address != address)
    if len(others) == len(settings.neighbours):
        raise RequestError("unknown-neighbour", f"neighbor {text} is not configured")
    return _changed(service, replace(settings, neighbours=others))


def neighbours(service: Service, _client: Client, _header: Header, _: bytes) -> Header:
    return {"neighbours": [plain(neighbour) for neighbour in service.settings.neighbours]}


async def _from_files(work: Callable[[], Result]) -> Result:
    """Reads files without blocking the loop: a disk that hangs fails only this request. Raises RequestError."""
    try:
        return await off_loop(work)
    except ConfigurationError as error:
        raise _request_error(error) from error
    except TimeoutError as error:
        raise RequestError("too-slow", f"timed out after {FILE_TIMEOUT_S:g} s while reading the file") from error


async def set_keys(service: Service, _client: Client, header: Header, _: bytes) -> Header:
    """Loads keys from a file, so that no key crosses the socket."""
    path = Path(_text(header, "file"))
    keys = await _from_files(lambda: read_keys(path))
    changes = service.apply(replace(service.settings, keys=keys, unkeyed=False))
    return {"changes": changes, "keys": [key.key_id.hex() for key in keys]}


async def reload(service: Service, _client: Client, _header: Header, _: bytes) -> Header:
    file = service.configured_file()
    return {"changes": service.apply_file(await _from_files(lambda: load(file)))}


# Recording


async def record_start(service: Service, client: Client, header: Header, _: bytes) -> Header:
    path, payloads = Path(_text(header, "path")), bool(header.get("payloads"))
    service.check_not_recording()
    directory = service.configuration.daemon.state_directory
    if client.user not in (0, os.geteuid()) and not await _from_files(lambda: is_below(path, directory)):
        # The daemon may have permission to write where the client does not.
        raise RequestError("cannot-record", f"{path}: clients of other users may only record below {directory}")
    service.start_recording(path, payloads)
    return {}


async def record_stop(service: Service, _client: Client, _header: Header, _: bytes) -> Header:
    recorder = await service.stop_recording()
    if recorder is None:
        raise RequestError("not-recording", "no recording is running")
    return {"path": str(recorder.path), "bytes": recorder.bytes, "lines": recorder.lines}


COMMANDS = {
    "publish": publish,
    "subscribe": subscribe,
    "acknowledge": acknowledge,
    "unsubscribe": unsubscribe,
    "subscriptions": subscriptions,
    "events": events,
    "ping": ping,
    "status": status,
    "peers": peers,
    "topics": topics,
    "logs": logs,
    "metrics": metrics_page,
    "set-topic": set_topic,
    "drop-topic": drop_topic,
    "set-window": set_window,
    "set-rates": set_rates,
    "set-position": set_position,
    "publish-meter": publish_meter,
    "set-radio": set_radio,
    **dict.fromkeys(("set-neighbor", "set-neighbour"), set_neighbour),
    **dict.fromkeys(("drop-neighbor", "drop-neighbour"), drop_neighbour),
    **dict.fromkeys(("neighbors", "neighbours"), neighbours),
    "set-keys": set_keys,
    "reload": reload,
    "record-start": record_start,
    "record-stop": record_stop,
}

__all__ = ["COMMANDS", "CONDITIONS_TOPIC", "render_metrics"]
