"""Query the daemon on a robot; runs there, in the release's Python, with the standard library only.

    facts                     prints the daemon's status and topics, in sections that start with `== NAME`
    online                    prints the peers that are online
    before                    prints, as one line of JSON, what must hold again after a switch: `Baseline`
    prove WAIT_S BEFORE UNIT... prints nothing once all is healthy, or after WAIT_S what is not

Called by the scripts beside this file. `take_snapshot` and `query` do all I/O; `flowing` and `problems` decide.
"""

from __future__ import annotations

import json
import socket
import struct
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

SOCKET = "/run/udp-mesh/udp-mesh.sock"
CURRENT = Path("/opt/udp-mesh/current")
QUERY_TIMEOUT_S = 10.0
POLL_INTERVAL_S = 0.25
# A daemon that dies at start is restarted within RestartSec=1: a healthy process must be older.
STEADY_S = 2.0
# The bridge loads all of ROS before it can fail; its own topic at the daemon shows earlier that it succeeded.
BRIDGE_STEADY_S = 8.0
BRIDGE_TOPIC = "bridge/ros1"
# A topic flows with this many messages within this time; a single message does not promise more.
FLOW_WATCH_S = 1.0
MIN_FLOW_MESSAGES = 2

Json = dict[str, Any]


class Baseline(NamedTuple):
    """The state under the previous release: online peers, received messages of flowing topics, and the boot ID of its
    process (a reload keeps the process and its counts)."""

    online: list[str]
    flowing: dict[str, int]
    boot: str


class ServiceState(NamedTuple):
    """A service in `systemctl show`; `started_s` is on the monotonic clock."""

    name: str
    active: str = ""
    sub: str = ""
    result: str = ""
    restarts: str = "0"
    started_s: float = 0.0

    def __str__(self) -> str:
        again = f", restarted {self.restarts} times" if self.restarts not in ("", "0") else ""
        result = f", {self.result}" if self.result not in ("", "success") else ""
        return f"{self.active or 'absent'} ({self.sub}{result}{again})"


class HealthSnapshot(NamedTuple):
    """The units, and the daemon's answers or why there are none."""

    units: list[ServiceState]
    status: Json
    topics: list[Json]
    no_answer_reason: str = ""

    @property
    def online(self) -> list[str]:
        peers = self.status.get("conditions", {}).get("peers", [])
        return sorted(str(peer["name"]) for peer in peers if peer.get("online"))


def flowing(first: list[Json], then: list[Json]) -> dict[str, int]:
    """Topics that received at least FLOW_MESSAGES between two snapshots, with their counts at the second."""
    counts = {topic["name"]: int(topic["received_messages"]) for topic in first}
    later = {topic["name"]: int(topic["received_messages"]) for topic in then}
    return {name: count for name, count in later.items() if count - counts.get(name, 0) >= MIN_FLOW_MESSAGES}


def problems(snapshot: HealthSnapshot, expected: list[str], baseline: Baseline, now_s: float) -> str:
    """Why the robot is not healthy yet, in one line; empty if it is. `expected` are the topics of the release."""
    for unit in snapshot.units:
        if unit.active != "active":
            return f"{_called(unit)} does not run: systemd says {unit}"
    if snapshot.no_answer_reason:
        return f"the daemon does not answer: {snapshot.no_answer_reason}"
    here = {topic["name"]: topic for topic in snapshot.topics}
    lacking = [name for name in expected if not here.get(name, {}).get("configured")]
    if lacking:
        return f"topics are missing: {', '.join(lacking)}"
    away = [peer for peer in baseline.online if peer not in snapshot.online]
    if away:
        return f"peers were online before and are not seen: {', '.join(away)}"
    same = snapshot.status.get("boot") == baseline.boot
    dry = [
        name
        for name, count in baseline.flowing.items()
        if name in here and int(here[name]["received_messages"]) <= (count if same else 0)
    ]
    if dry:
        return f"topics flowed before and receive nothing: {', '.join(dry)}"
    young = [
        unit
        for unit in snapshot.units
        if now_s - unit.started_s < (BRIDGE_STEADY_S if _is_bridge(unit) and BRIDGE_TOPIC not in here else STEADY_S)
    ]
    return f"{_called(young[0])} has just started" if young else ""


def _is_bridge(unit: ServiceState) -> bool:
    return "ros" in unit.name


def _called(unit: ServiceState) -> str:
    if _is_bridge(unit):
        return "the ROS bridge"
    return "the service for /etc/hosts" if "hosts" in unit.name else "the daemon"


def query(*operations: str) -> list[Json]:
    """The daemon's replies. Raises OSError, and ValueError for an invalid reply (docs/local-api.md)."""
    with socket.socket(socket.AF_UNIX) as server:
        server.settimeout(QUERY_TIMEOUT_S)
        server.connect(SOCKET)
        with server.makefile("rwb") as stream:
            replies = []
            for number, operation in enumerate(operations):
                header = json.dumps({"op": operation, "id": number}).encode()
                stream.write(struct.pack(">II", len(header), 0) + header)
                stream.flush()
                reply: Json = {}
                while reply.get("id") != number:
                    lengths = stream.read(8)
                    if len(lengths) < 8:
                        raise ConnectionResetError("it closed the connection")
                    head, payload = struct.unpack(">II", lengths)
                    reply = json.loads(stream.read(head))
                    stream.read(payload)
                replies.append(reply)
            return replies


def take_snapshot(units: list[str]) -> HealthSnapshot:
    states = [_unit(unit) for unit in units]
    try:
        status, topics = query("status", "topics")
    except (OSError, ValueError) as error:
        return HealthSnapshot(states, {}, [], str(error) or type(error).__name__)
    return HealthSnapshot(states, status, list(topics.get("topics", ())))


def _unit(name: str) -> ServiceState:
    asked = "ActiveState,SubState,Result,NRestarts,ExecMainStartTimestampMonotonic"
    shown = subprocess.run(["systemctl", "show", "-p", asked, name], capture_output=True, text=True, check=False)
    values = dict(line.partition("=")[::2] for line in shown.stdout.splitlines())
    active, sub, result, restarts, started_us = (values.get(key, "") for key in asked.split(","))
    started_s = int(started_us) / 1e6 if started_us.isdecimal() else 0.0
    return ServiceState(name, active, sub, result, restarts, started_s)


def baseline() -> Baseline:
    """Measures flowing topics for FLOW_WATCH_S, but only if a topic was received recently."""
    first = take_snapshot([])
    recent = [
        topic for topic in first.topics if (age := topic.get("received_ago_s")) is not None and age < FLOW_WATCH_S
    ]
    flows: dict[str, int] = {}
    if recent:
        time.sleep(FLOW_WATCH_S)
        flows = flowing(first.topics, take_snapshot([]).topics)
    return Baseline(first.online, flows, str(first.status.get("boot", "")))


def wait_healthy(wait_s: float, was: Baseline, units: list[str]) -> str:
    """Poll until all is healthy; after `wait_s` return what is not."""
    wanted = (CURRENT / "topics").read_text(encoding="utf-8").splitlines()
    deadline = time.monotonic() + wait_s
    while True:
        reason = problems(take_snapshot(units), wanted, was, time.monotonic())
        if not reason or time.monotonic() >= deadline:
            return reason
        time.sleep(POLL_INTERVAL_S)


def main(words: list[str]) -> None:
    if words[0] == "facts":
        snapshot = take_snapshot([])
        sys.stdout.write(
            f"== status\n{json.dumps(snapshot.status)}\n== topics\n{json.dumps({'topics': snapshot.topics})}\n"
        )
    elif words[0] == "online":
        sys.stdout.write(" ".join(take_snapshot([]).online))
    elif words[0] == "before":
        sys.stdout.write(f"{json.dumps(baseline())}\n")
    else:
        _, wait_s, was, *units = words
        sys.stdout.write(wait_healthy(float(wait_s), Baseline(*json.loads(was)), units))


if __name__ == "__main__":
    main(sys.argv[1:])
