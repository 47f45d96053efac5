"""Recordings of udp-mesh for tests, with what a daemon writes."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

START_S = 1_790_000_000.0
SECONDS = 60
# the peers are offline from here on, for ten seconds
OFFLINE_S = START_S + 40
TEAM = ("base", "spot1", "husky1")


def write_recording(file: Path, node: str, suffix: str = "", seconds: int = SECONDS) -> Path:
    """A recording of `node` in a team; `suffix` ends the name of every topic, event and other peer."""
    head = {"recording": 1, "node": node, "boot": "b", "started": START_S, "payloads": False}
    with file.open("w", encoding="utf-8") as out:
        for entry in (head, *_lines(node, [name for name in TEAM if name != node], suffix, seconds)):
            out.write(json.dumps(entry) + "\n")
    return file


def _lines(node: str, others: list[str], suffix: str, seconds: int) -> Iterator[dict[str, Any]]:
    peers = [*others, f"stranger{suffix}"] if suffix else others
    for t in range(seconds):
        is_online = START_S + t not in range(int(OFFLINE_S), int(OFFLINE_S) + 10)
        changes = {0: "peer-online", 40: "peer-offline", 50: "peer-online"}
        for peer in peers:
            if t in changes:
                yield {"t": t, "kind": changes[t], "peer": peer}
            if is_online:
                for topic, priority, size in (("telemetry", 3, 300), ("map", 6, 20_000)):
                    yield {
                        "t": t + 0.2, "kind": "received", "source": peer, "topic": f"{topic}{suffix}",
                        "priority": priority, "bytes": size, "broadcast": False, "type_name": "",
                    }  # fmt: skip
                yield {
                    "t": t + 0.3, "kind": "message-delivered", "message_id": t, "peer": peer,
                    "topic": f"commands{suffix}", "latency_s": 0.03 + 0.01 * (t % 3),
                }  # fmt: skip
        yield {
            "t": t + 0.1, "kind": "sent", "message": t, "topic": f"commands{suffix}", "priority": 1, "bytes": 90,
            "to": None, "reliable": True,
        }  # fmt: skip
        yield {"t": t + 0.4, "kind": "place", "at": node, "x": 0.1 * len(node) * t, "y": 2.0, "z": None, "age_s": 0.0}
        yield {
            "t": t + 0.45, "kind": "conditions", "name": node,
            "peers": [
                {
                    "name": peer, "online": is_online, "heard_ago_s": 0.2, "round_trip_s": 0.02, "loss": 0.1,
                    "outbox_messages": 0 if is_online else t, "capacity_bits_per_s": 8e6,
                    "queues": [{"priority": 3, "messages": 1, "bytes": 300, "oldest_s": 0.4}],
                }
                for peer in peers
            ],
        }  # fmt: skip
    yield {"t": seconds, "kind": f"topic-starved{suffix}", "peer": peers[-1], "topic": f"map{suffix}"}
