"""The daemon's configuration: TOML file -> `Configuration`, with every problem reported by file and line.

`load` reads the file and the key file it names; `read` is the pure part. `settings` holds the core's values, `daemon`
those of the process. SIGHUP reads the same file again; a file with problems changes nothing. docs/udp-mesh.md describes
the keys.
"""

from __future__ import annotations

import dataclasses
import ipaddress
import logging
import os
import re
import socket
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from udp_mesh.core.settings import (
    DEFAULT_PORT,
    Address,
    Limits,
    Rates,
    Settings,
    Topic,
)
from udp_mesh.crypto import Key
from udp_mesh.daemon.file_access import is_exposed, read_regular
from udp_mesh.daemon.interface import (
    BENCH_TOPIC,
    DEFAULT_SOCKET,
    PING_TOPIC,
    PONG_TOPIC,
    POSITION_TOPIC,
)
from udp_mesh.daemon.neighbours import (
    NODE_NAME,
    is_node_name,
    parse_address,
    read_link,
    read_neighbours,
)
from udp_mesh.daemon.positions import (
    DEFAULT_FRAME,
    MAX_COORDINATE_M,
    MAX_FRAME_BYTES,
    Position,
    PositionSource,
    is_frame,
)
from udp_mesh.daemon.relay_settings import read_relay
from udp_mesh.daemon.thin_settings import ThinPortConfig, read_thin
from udp_mesh.daemon.toml_source import ConfigurationError, Problem, Table, may_be_key, parse
from udp_mesh.daemon.topic_settings import or_default, problem_from, read_topic
from udp_mesh.links.attachments import EVERY_INTERFACE, LinkConfig
from udp_mesh.wire.limits import MAX_MESSAGE_BYTES

log = logging.getLogger(__name__)

DEFAULT_STATE_DIRECTORY = Path("/var/lib/udp-mesh")
MAX_SOCKET_PATH_BYTES = 107
"""Maximum length of a Unix socket's path, without the terminating NUL."""
MAX_FILE_BYTES = 1 << 20
"""A larger configuration file is a mistake, such as a wrong path."""

RESERVED_TOPICS = (
    # Reliable: a ping measures whether and how fast an urgent message makes the round trip, not whether one datagram
    # does. The conditions report the share of lost datagrams.
    Topic(PING_TOPIC, priority=0, deadline_s=10.0, always=True),
    Topic(PONG_TOPIC, priority=0, deadline_s=10.0, always=True),
    Topic(BENCH_TOPIC, priority=15, reliable=True, always=True),
    # The next one comes in seconds: a lost one is not sent again, an old one not at all.
    Topic(
        POSITION_TOPIC,
        priority=13,
        reliable=False,
        keep_last=1,
        deadline_s=5.0,
        always=True,
        thin=True,
        thin_period_s=30.0,
    ),
)


@dataclass(frozen=True, slots=True)
class DaemonSettings:
    """Settings of the process, besides the core's."""

    socket: Path = DEFAULT_SOCKET
    socket_mode: int = 0o660
    socket_group: str | None = None
    user: str | None = None
    """User to switch to once the sockets are open (None: stay)."""
    state_directory: Path = DEFAULT_STATE_DIRECTORY
    metrics_address: Address | None = None
    """Loopback address of the Prometheus endpoint (None: metrics only through the local socket)."""
    conditions_period_s: float = 1.0
    outbox_disk_bytes: int = 1 << 30
    """Limit of all outboxes on disk together: room for a peer that stays away for days."""
    record_bytes: int = 1 << 30
    """Limit of one recording, so that a forgotten one does not fill the disk."""
    urgent_dscp: int = 46
    """DSCP of urgent datagrams: 46 (EF, RFC 3246) maps to wifi's video queue, ahead of best effort."""


@dataclass(frozen=True, slots=True)
class Configuration:
    """The daemon's complete configuration."""

    settings: Settings
    links: tuple[LinkConfig, ...] = EVERY_INTERFACE
    daemon: DaemonSettings = field(default_factory=DaemonSettings)
    thin_ports: tuple[ThinPortConfig, ...] = ()
    position: Position | None = None
    """The fixed position of a node that does not move."""
    file: Path | None = None


def load(path: Path) -> Configuration:
    """Loads a configuration file and the key file it names. Raises ConfigurationError."""
    text = _read_text(path)
    top = parse(text, str(path))
    key_file, unkeyed = top.text("key_file"), top.boolean("unkeyed", False)
    keys: tuple[Key, ...] = ()
    if key_file is not None and unkeyed:
        top.source.report(("unkeyed",), "either key_file or unkeyed", "both")
    if key_file is not None:
        keys = _read_named_keys(top, path, "key_file", key_file)
    elif not unkeyed:
        top.source.report(
            ("key_file",), "a file with the fleet's key", "none", "set unkeyed = true to run without protection"
        )
    relay_key_file = top.text("relay_key_file")
    relay_keys = () if relay_key_file is None else _read_named_keys(top, path, "relay_key_file", relay_key_file)
    return dataclasses.replace(read(top, keys, relay_keys), file=path)


def _read_named_keys(top: Table, path: Path, key: str, name: str) -> tuple[Key, ...]:
    """The keys of the file that the configuration names; its problems are added to those of the configuration."""
    if may_be_key(name) and not (path.parent / name).exists():
        top.report(key, "the name of a file with the key", name, "udp-mesh keygen writes one")
        return ()
    try:
        # Relative to the configuration file, so that a bundle can be moved as a whole.
        return read_keys(path.parent / name)
    except ConfigurationError as error:
        line = top.source.line((key,))
        top.source.problems += [
            dataclasses.replace(problem, file=str(path), line=line, key=key, found=f"{problem.file}: {problem.found}")
            if problem.line == 0
            else problem
            for problem in error.problems
        ]
        return ()


def read_keys(path: Path) -> tuple[Key, ...]:
    """The one or two keys of a key file, one per line, the sealing key first. Raises ConfigurationError."""
    keys: list[Key] = []
    problems: list[Problem] = []
    for number, line in enumerate(_read_text(path).splitlines(), start=1):
        words = line.split("#")[0].strip()
        if not words:
            continue
        try:
            key = Key.parse(words)
        except ValueError as error:
            expected, _, found = str(error).removeprefix("expected ").partition(", found ")
            problems.append(Problem(str(path), number, "", expected, found))
            continue
        if not any(key.secret):
            problems.append(Problem(str(path), number, "", "a random key (udp-mesh keygen)", "only zeros"))
        keys.append(key)
    if not problems and not 1 <= len(keys) <= 2:
        problems.append(Problem(str(path), 1, "", "one or two keys, one per line", f"{len(keys)}"))
    elif len(set(keys)) < len(keys):
        problems.append(Problem(str(path), 0, "", "two different keys", "the same key twice"))
    if problems:
        raise ConfigurationError(problems)
    if is_exposed(path):
        log.warning("key-file-exposed path=%s readable by every user of this computer: run chmod 600", path)
    return tuple(keys)


def _read_text(path: Path) -> str:
    name = str(path)
    try:
        raw = read_regular(path, MAX_FILE_BYTES)
    except OSError as error:
        raise ConfigurationError([Problem(name, 0, "", "a readable file", f"{error.strerror}")]) from error
    if len(raw) > MAX_FILE_BYTES:
        raise ConfigurationError([Problem(name, 0, "", f"a file of at most {MAX_FILE_BYTES} bytes", "a larger one")])
    try:
        return raw.decode()
    except UnicodeDecodeError as error:
        place = raw[: error.start].count(b"\n") + 1
        raise ConfigurationError([Problem(name, place, "", "UTF-8", f"byte {raw[error.start]:#04x}")]) from error


def read(top: Table, keys: tuple[Key, ...], relay_keys: tuple[Key, ...] = ()) -> Configuration:
    """The configuration in a parsed file. Raises ConfigurationError with every problem found."""
    source = top.source
    top.text("key_file")
    unkeyed = top.boolean("unkeyed", False)
    name = top.text("name", socket.gethostname().split(".")[0]) or ""
    if not is_node_name(name):
        top.report("name", NODE_NAME, name)
    port = top.integer("port", DEFAULT_PORT, 1, 65_535) or DEFAULT_PORT
    window = top.integer_or_word("window", "adaptive", 1, 4096)
    selective = top.boolean("selective", True)
    fragment_bytes = top.integer("fragment_bytes", 1400, 64, 8192) or 1400
    topics = tuple(read_topic(topic, entry) for topic, entry in top.table("topics").named_tables())
    undeclared = read_topic("*", top.table("undeclared")) if top.has("undeclared") else None
    links = tuple(read_link(entry) for entry in top.tables("links")) or EVERY_INTERFACE
    neighbours = read_neighbours(top, port)
    rates, limits = read_rates(top.table("rates")), _read_limits(top.table("limits"))
    daemon = _read_daemon(top.table("daemon"))
    top.text("relay_key_file")
    relay = read_relay(top, relay_keys)
    thin, thin_ports = read_thin(top.table("thin"))
    position = _read_position(top.table("position")) if top.has("position") else None
    top.finish()
    if source.problems:
        raise ConfigurationError(source.all_problems())
    try:
        settings = Settings(
            name=name,
            relay=relay,
            thin=thin,
            port=port,
            keys=keys,
            unkeyed=unkeyed,
            topics=(*topics, *RESERVED_TOPICS),
            undeclared=undeclared,
            neighbours=neighbours,
            window=_window(window),
            fragment_bytes=fragment_bytes,
            confirms=True,
            selective=selective,
            rates=rates,
            limits=limits,
        )
    except ValueError as error:
        raise ConfigurationError([problem_from(source, error)]) from error
    return Configuration(settings, links, daemon, thin_ports, position)


def _window(packets: int | None) -> Literal["adaptive"] | int:
    return "adaptive" if packets is None else packets


def read_rates(table: Table, current: Rates | None = None) -> Rates:
    """The protocol's times and thresholds; keys missing from the table keep the value in `current`."""
    base = current or Rates()
    changes: dict[str, float | int] = {}
    for entry in dataclasses.fields(Rates):
        before = getattr(base, entry.name)
        value: float | int | None
        if isinstance(before, int):
            value = table.integer(entry.name, None, 0, 1 << 16)
        else:
            value = table.number(entry.name, None, 0.0, 86_400.0)
        if value is not None:
            changes[entry.name] = value
    table.finish()
    try:
        return dataclasses.replace(base, **changes)  # type: ignore[arg-type]
    except ValueError as error:
        table.source.problems.append(problem_from(table.source, error))
        return base


def _read_limits(table: Table) -> Limits:
    values = {
        entry.name: or_default(
            table.integer(entry.name, None, 1, MAX_MESSAGE_BYTES if entry.name == "message_bytes" else 1 << 40),
            getattr(Limits(), entry.name),
        )
        for entry in dataclasses.fields(Limits)
    }
    table.finish()
    return Limits(**values)


def _read_daemon(table: Table) -> DaemonSettings:
    default = DaemonSettings()
    octal = 'octal permissions in quotes such as "0660"'
    mode_text = table.text("socket_mode", f"{default.socket_mode:04o}", octal) or ""
    mode = default.socket_mode
    if re.fullmatch(r"0?[0-7]{3}", mode_text):
        mode = int(mode_text, 8)
    else:
        table.report("socket_mode", octal, mode_text)
    metrics_text = table.text("metrics_address")
    metrics = parse_address(metrics_text, 0) if metrics_text is not None and metrics_text.count(":") else None
    if metrics_text is not None and (metrics is None or not ipaddress.ip_address(metrics[0]).is_loopback):
        table.report("metrics_address", "a loopback address with a port (127.0.0.1:9871)", metrics_text)
    socket_path = _read_path(table, "socket", default.socket)
    if len(os.fsencode(socket_path)) > MAX_SOCKET_PATH_BYTES:
        table.report("socket", f"a path of at most {MAX_SOCKET_PATH_BYTES} bytes (unix(7))", str(socket_path))
    settings = DaemonSettings(
        socket=socket_path,
        socket_mode=mode,
        socket_group=table.text("socket_group"),
        user=table.text("user"),
        state_directory=_read_path(table, "state_directory", default.state_directory),
        metrics_address=metrics,
        conditions_period_s=table.number("conditions_period_s", default.conditions_period_s, 0.05, 3600) or 1.0,
        outbox_disk_bytes=or_default(table.integer("outbox_disk_bytes", None, 0, 1 << 40), default.outbox_disk_bytes),
        record_bytes=or_default(table.integer("record_bytes", None, 1 << 16, 1 << 40), default.record_bytes),
        urgent_dscp=or_default(table.integer("urgent_dscp", None, 0, 63), default.urgent_dscp),
    )
    table.finish()
    return settings


def _read_position(table: Table) -> Position:
    """`x_m`, `y_m` and optional `z_m` and `frame`."""
    high = MAX_COORDINATE_M
    for key in ("x_m", "y_m"):
        if not table.has(key):
            table.source.report((*table.path, key), "a number of meters", "none")
    frame = table.text("frame", DEFAULT_FRAME) or ""
    if not is_frame(frame):
        table.report("frame", f"a name of 1 to {MAX_FRAME_BYTES} bytes without spaces", frame)
    x_m, y_m, z_m = (table.number(key, None, -high, high) for key in ("x_m", "y_m", "z_m"))
    table.finish()
    return Position(x_m or 0.0, y_m or 0.0, z_m, frame, 0.0, PositionSource.CONFIGURATION)


def _read_path(table: Table, key: str, default: Path) -> Path:
    text = table.text(key)
    if text == "":
        table.report(key, "a path", text)
    return Path(text) if text else default
