"""Requests with fields of any kind: each is answered, and none ends a connection or leaves a traceback."""

from __future__ import annotations

import json
import random
from pathlib import Path

from tests.udp_mesh.daemon.processes import RunningDaemon
from tests.udp_mesh.links.sockets import free_port
from udp_mesh.client import MeshError
from udp_mesh.daemon.commands import COMMANDS

REQUESTS = 1500
FIELDS = {
    "publish": ("topic", "to", "type", "notify"),
    "subscribe": ("topics", "acknowledge", "rate_hz", "max_age_s"),
    "unsubscribe": ("topics",),
    "acknowledge": ("receipts",),
    "ping": ("peer", "timeout_s"),
    "set-topic": ("topic", "values"),
    "drop-topic": ("topic",),
    "set-window": ("window",),
    "set-rates": ("values",),
    "set-position": ("x_m", "y_m", "z_m", "frame", "time_s"),
    "set-neighbor": ("address", "name", "link", "legacy"),
    "drop-neighbor": ("address",),
    "set-keys": ("file",),
}
"""Commands without an entry have no fields, or write files wherever these say."""
NUMBERS = (0, 1, -1, 0.01, 2.5, 100, 2**31, 2**64, 10**400, -(10**400), 1e308, float("nan"), float("inf"), True, None)
TEXTS = (
    *("", "a", "topic1", "*", "[z-a", "~mesh/ping", "\ud800", "\0", "line\nbreak", "x" * 300, "é" * 40, "../../x"),
    *("127.0.0.1:8700", "[fe80::1%lo]:3", "127.0.0.1:99999", "adaptive", "last", "base"),
)
KEYS = (
    *("priority", "reliable", "keep_last", "deadline_s", "rate_limit_bytes_per_s", "outbox", "outbox_bytes", "log"),
    *("compression", "delta", "repair", "destinations", "thin", "readers", "heartbeat_s", "pack_s", "offline_s"),
    *("source", "problem", "paths", "neighbors", "peer", "age_s", "signal_dbm", "trend", "next_hop"),
)


def value(dice: random.Random, depth: int = 0) -> object:
    match dice.randrange(6 if depth < 3 else 4):
        case 0 | 1:
            return dice.choice(NUMBERS)
        case 2 | 3:
            return dice.choice(TEXTS)
        case 4:
            return [value(dice, depth + 1) for _ in range(dice.randrange(3))]
        case _:
            return {dice.choice(KEYS): value(dice, depth + 1) for _ in range(dice.randrange(5))}


def test_requests_with_any_fields_are_answered(tmp_path: Path) -> None:
    daemon = RunningDaemon(
        tmp_path,
        "a",
        f"""
name = "a"
unkeyed = true
port = {free_port()}
[topics]
topic1 = {{ priority = 3 }}
artifact = {{ priority = 4, log = {{ readers = ["a", "b"] }} }}
[[links]]
address = "127.0.0.1"
[daemon]
socket = "{tmp_path}/a.sock"
state_directory = "{tmp_path}/state"
""",
    )
    dice = random.Random(1)
    accepted = refused = 0
    with daemon, daemon.client() as client:
        for _ in range(REQUESTS):
            op = dice.choice(tuple(COMMANDS))
            fields = {name: value(dice) for name in FIELDS.get(op, ()) if dice.random() < 0.9}
            if "topic" in fields and dice.random() < 0.7:
                fields["topic"] = dice.choice(("topic1", "topic2", "artifact"))
            try:
                client.request(op, json.dumps(value(dice)).encode(), **fields)
                accepted += 1
            except MeshError as error:
                refused += 1
                assert error.code not in ("unreachable", "timeout"), (op, fields, error)
        log = daemon.log.read_text()
    assert "Traceback" not in log, log[-3000:]
    assert min(accepted, refused) > REQUESTS / 5
