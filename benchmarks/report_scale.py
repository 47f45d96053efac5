"""`udp-mesh report` over hours of a large team: `python -m benchmarks.report_scale [--robots 20] [--hours 2] [--fill]`.

Synthetic recordings with the lines that a daemon writes, from a seed: conditions of all peers every second, telemetry
at 2 Hz from every peer that is online, commands with their outcomes, positions, and peers that come and go. `udp-mesh
report` of 1, 3 and all robots' recordings runs as a process of its own; measured are its processor time, its largest
resident set, and the size of the page.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import random
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from benchmarks.page import fill, this_machine
from udp_mesh.core.conditions import Conditions, Counters, PeerConditions, QueueConditions
from udp_mesh.daemon.status import conditions_json

RESULTS = Path(__file__).with_name("results") / "report_scale.jsonl"
STARTED_S = 1_764_000_000.0
TELEMETRY_HZ = 2
# A robot in a tunnel is heard for some minutes, and out of reach for some.
_ONLINE_S, _OFFLINE_S = 300.0, 60.0


def team(robots: int) -> list[str]:
    return ["base", *(f"robot{number:02d}" for number in range(1, robots))]


class _Peer:
    """What one robot's daemon has about another one."""

    def __init__(self, name: str, number: int, rng: random.Random) -> None:
        self.rng = rng
        self.is_online = True
        self.changes_s = rng.expovariate(1 / _ONLINE_S)
        self.conditions = PeerConditions(
            name, online=True, legacy=False, address=(f"10.42.1.{number}", 47800), link="wifi", online_since=0.0,
            last_heard=0.0, round_trip_s=0.02, least_round_trip_s=0.004, loss=0.0, sent_bits_per_s=0.0,
            delivered_bits_per_s=0.0, received_bits_per_s=0.0, arrived_bits_per_s=0.0, peer_sends_bits_per_s=0.0,
            capacity_bits_per_s=8e6, window_packets=40.0, in_flight_packets=0, retransmitted_packets=0,
            queues=tuple(QueueConditions(priority, 0, 0, 0.0, 0.0, 0.0) for priority in (0, 1, 3, 6)),
            outbox_messages=0, outbox_bytes=0, one_way=False, unanswered_for_s=None,
        )  # fmt: skip

    def advance(self, t: int) -> bool:
        """One second on; whether the peer went online or offline."""
        has_changed = t >= self.changes_s
        if has_changed:
            self.is_online = not self.is_online
            self.changes_s = t + self.rng.expovariate(1 / (_ONLINE_S if self.is_online else _OFFLINE_S))
        draw = self.rng.random
        now = self.conditions
        waiting = 0 if self.is_online else now.outbox_messages + 2
        self.conditions = replace(
            now,
            online=self.is_online,
            last_heard=t - draw() if self.is_online else now.last_heard,
            round_trip_s=0.005 + 0.03 * draw(),
            loss=0.2 * draw(),
            sent_bits_per_s=1e5 * draw(),
            delivered_bits_per_s=9e4 * draw(),
            received_bits_per_s=1e5 * draw(),
            arrived_bits_per_s=9e4 * draw(),
            peer_sends_bits_per_s=1e6 * draw(),
            capacity_bits_per_s=4e6 + 8e6 * draw(),
            window_packets=10 + 60 * draw(),
            queues=tuple(
                replace(queue, messages=waiting, bytes=300 * waiting, oldest_s=waiting / 2) for queue in now.queues
            ),
            outbox_messages=waiting,
            outbox_bytes=300 * waiting,
            sent_bytes=now.sent_bytes + 12_000,
            received_bytes=now.received_bytes + 12_000,
        )
        return has_changed


def entries(node: str, names: Sequence[str], seconds: int, seed: int) -> Iterator[dict[str, Any]]:
    """The lines of one robot's recording."""
    rng = random.Random(seed)
    yield {"recording": 1, "node": node, "boot": f"{seed:032x}", "started": STARTED_S, "payloads": False}
    peers = [_Peer(name, number, rng) for number, name in enumerate(names, 1) if name != node]
    phase = 2 * math.pi * rng.random()
    for t in range(seconds):
        yield from _positions(node, t, phase)
        for peer in peers:
            if peer.advance(t):
                yield {
                    "t": t,
                    "kind": "peer-online" if peer.is_online else "peer-offline",
                    "peer": peer.conditions.name,
                }
        for turn in range(TELEMETRY_HZ):
            for peer in peers:
                if peer.is_online:
                    yield {
                        "t": round(t + (turn + 0.1 * rng.random()) / TELEMETRY_HZ, 6), "kind": "received",
                        "source": peer.conditions.name, "type_name": "nav_msgs/Odometry", "topic": "telemetry",
                        "priority": 3, "bytes": 700, "broadcast": True,
                    }  # fmt: skip
        yield {
            "t": t + 0.6, "kind": "sent", "message": t, "topic": "commands", "priority": 1, "bytes": 90,
            "to": names[0], "reliable": True,
        }  # fmt: skip
        yield {
            "t": t + 0.7, "kind": "message-delivered", "message_id": t, "peer": names[0], "topic": "commands",
            "latency_s": round(0.01 + rng.expovariate(30), 6),
        }  # fmt: skip
        counters = Counters(datagrams_sent=40 * t, bytes_sent=30_000 * t, fragments_sent=35 * t)
        conditions = Conditions(
            t + 0.8, node, tuple(peer.conditions for peer in peers), counters, 1e6, 5e6, 0, 0, 0, ()
        )
        yield {"t": t + 0.8, "kind": "conditions", **conditions_json(conditions)}


def _positions(node: str, t: int, phase: float) -> Iterator[dict[str, Any]]:
    x_m, y_m = 100 * math.sin(t / 900 + phase), 60 * math.cos(t / 700 + phase)
    yield {
        "t": t, "kind": "place", "at": node, "x": round(x_m, 2), "y": round(y_m, 2), "z": None, "frame": "map",
        "age_s": 0.0,
    }  # fmt: skip


def write_recordings(directory: Path, robots: int, seconds: int, recordings: int) -> list[Path]:
    names = team(robots)
    files = []
    for seed, node in enumerate(names[:recordings]):
        file = directory / f"{node}.jsonl"
        with file.open("w", encoding="ascii") as out:
            for entry in entries(node, names, seconds, seed):
                out.write(json.dumps(entry, separators=(",", ":")) + "\n")
        files.append(file)
    return files


def measured(files: Sequence[Path], page: Path) -> dict[str, Any]:
    """One report, as a process of its own."""
    began_s = time.monotonic()
    process = subprocess.Popen(
        [sys.executable, "-m", "udp_mesh.cli.main", "report", *map(str, files), "--out", str(page)],
        stdout=subprocess.DEVNULL,
    )
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise RuntimeError(f"udp-mesh report ended with {process.returncode}")
    return {
        "recordings": len(files),
        "recorded_mb": round(sum(file.stat().st_size for file in files) / 1e6, 1),
        "cpu_s": round(usage.ru_utime + usage.ru_stime, 1),
        "elapsed_s": round(time.monotonic() - began_s, 1),
        "memory_mib": round(usage.ru_maxrss / 1024, 1),
        "page_mb": round(page.stat().st_size / 1e6, 2),
    }


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    lines = [
        "| robots | hours | recordings | MB recorded | CPU, s | CPU per 100 MB, s | memory, MiB | page, MB |",
        "|" + " --- |" * 8,
    ]
    for row in rows:
        per_size = f"{100 * row['cpu_s'] / row['recorded_mb']:.1f}"
        cells = (
            *(
                row["robots"],
                f"{row['hours']:g}",
                row["recordings"],
                f"{row['recorded_mb']:.0f}",
                f"{row['cpu_s']:.0f}",
            ),
            *(per_size, f"{row['memory_mib']:.0f}", f"{row['page_mb']:.1f}"),
        )
        lines.append(f"| {' | '.join(map(str, cells))} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.report_scale", description=__doc__)
    parser.add_argument("--robots", type=int, default=20)
    parser.add_argument("--hours", type=float, default=2.0)
    parser.add_argument("--recordings", default="", help="comma-separated numbers of recordings (default: 1,3,ROBOTS)")
    parser.add_argument("--fill", action="store_true", help="write the table to docs/benchmarks.md")
    arguments = parser.parse_args()
    counts = [int(count) for count in (arguments.recordings or f"1,3,{arguments.robots}").split(",")]
    rows: list[dict[str, Any]] = []
    # hours of a team are gigabytes: not in a directory that may be memory
    Path("build").mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory(dir="build") as folder:
        seconds = round(arguments.hours * 3600)
        files = write_recordings(Path(folder), arguments.robots, seconds, max(counts))
        for count in counts:
            row = measured(files[:count], Path(folder) / "report.html")
            rows.append({"robots": arguments.robots, "hours": arguments.hours, **row, **this_machine()})
            print(json.dumps(rows[-1]), flush=True)
    RESULTS.write_text("".join(json.dumps(row) + "\n" for row in rows))
    machine = this_machine()
    text = f"{table(rows)}\n\n{machine['cores']} cores, {machine['machine']}, Python {machine['python']}"
    print(text)
    if arguments.fill:
        fill("report", text)


if __name__ == "__main__":
    main()
