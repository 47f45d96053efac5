"""Differences of versions: bytes, processor time and latency per kind of data, and an hour's share of full maps.

    python -m benchmarks.differences [--versions N] [--minutes M]

The data are made by this script from a seed: they mimic the layout of the formats (octomap's bit stream and its
full tree, PointCloud2 with 16-byte points, OccupancyGrid with one byte per cell, JSON telemetry), growing as a robot
explores. JPEG images and compressed data are random bytes behind a header, which is what they look like to a
compressor. Each version goes through two nodes of the simulator, so what is counted includes headers and
acknowledgments; processor time is that of the whole process per version, latency is virtual time on the radio channel.
"""

from __future__ import annotations

import argparse
import json
import random
import struct
import time
from collections.abc import Callable, Iterator
from typing import Any

from udp_mesh.core.events import Event, MessageReceived
from udp_mesh.core.settings import Settings, Topic
from udp_mesh.sim.medium import RadioChannel
from udp_mesh.sim.team import Team

WAYS = ("plain", "zstd", "delta")
PERIOD_S = 10.0


def _tunnel(rng: random.Random, cells: int) -> Iterator[tuple[int, int, int]]:
    """Cells of a tunnel's wall, in the order a robot sees them."""
    y = z = 0.0
    for number in range(cells):
        if number % 40 == 0:
            y, z = y + rng.uniform(-1, 1), z + rng.uniform(-0.3, 0.3)
        yield number // 40, round(y + rng.gauss(0, 6)), round(z + rng.gauss(0, 4))


def octomap_bt(versions: int, rng: random.Random) -> list[bytes]:
    """A bit stream, two bits per child: new subtrees are inserted at several places, few bytes change."""
    tree = bytearray(rng.choices(bytes([0x00, 0x55, 0xAA, 0x59, 0x65, 0xFF]), k=60_000))
    made = []
    for _ in range(versions):
        for _ in range(40):
            at = rng.randrange(len(tree))
            tree[at:at] = bytes(rng.choices(bytes([0x00, 0x55, 0xAA, 0x59, 0x65, 0xFF]), k=rng.randrange(8, 90)))
        made.append(b"# Octomap OcTree binary file\nres 0.1\ndata\n" + bytes(tree))
    return made


def octomap_ot(versions: int, rng: random.Random) -> list[bytes]:
    """A log-odds float and a child mask per node: the occupancy of what is seen changes slightly everywhere near."""
    nodes = [rng.gauss(0, 1.5) for _ in range(200_000)]
    masks = rng.randbytes(len(nodes))
    made = []
    for _ in range(versions):
        start = rng.randrange(len(nodes) - 20_000)
        for at in range(start, start + 20_000):
            nodes[at] = max(-2.0, min(3.5, nodes[at] + rng.choice((0.85, -0.4))))
        body = b"".join(struct.pack("<fB", value, mask) for value, mask in zip(nodes, masks, strict=True))
        made.append(b"# Octomap OcTree file\nres 0.1\ndata\n" + body)
    return made


def point_cloud(versions: int, rng: random.Random) -> list[bytes]:
    """Sorted voxel centers, x, y, z and intensity as floats."""
    points: set[tuple[int, int, int]] = set()
    cells = _tunnel(rng, versions * 3000)
    made = []
    for _ in range(versions):
        points.update(cell for cell, _ in zip(cells, range(3000), strict=False))
        packed = (struct.pack("<ffff", x / 10, y / 10, z / 10, (x * 7 + y) % 255) for x, y, z in sorted(points))
        made.append(b"".join(packed))
    return made


def occupancy_grid(versions: int, rng: random.Random) -> list[bytes]:
    """800 x 800 cells of -1, 0 to 100."""
    grid = bytearray(b"\xff" * 640_000)
    made = []
    for _ in range(versions):
        x, y = rng.randrange(700), rng.randrange(700)
        for row in range(y, y + 80):
            grid[row * 800 + x : row * 800 + x + 90] = bytes(rng.choices((0, 0, 0, 1, 3, 100), k=90))
        made.append(bytes(grid))
    return made


def telemetry(versions: int, rng: random.Random) -> list[bytes]:
    state: dict[str, Any] = {f"joint_{number}": {"position": 0.0, "effort": 0.0, "ok": True} for number in range(30)}
    made = []
    for number in range(versions):
        for joint in rng.sample(sorted(state), 6):
            state[joint] = {"position": round(rng.gauss(0, 1), 4), "effort": round(rng.gauss(0, 9), 3), "ok": True}
        made.append(json.dumps({"stamp": 1000 + number * 0.1, "joints": state}).encode())
    return made


def jpeg(versions: int, rng: random.Random) -> list[bytes]:
    return [b"\xff\xd8\xff\xe0\x00\x10JFIF" + rng.randbytes(60_000) + b"\xff\xd9" for _ in range(versions)]


def compressed(versions: int, rng: random.Random) -> list[bytes]:
    return [b"\x1f\x8b\x08\x00" + rng.randbytes(200_000) for _ in range(versions)]


KINDS: dict[str, Callable[[int, random.Random], list[bytes]]] = {
    "octomap .bt": octomap_bt,
    "octomap .ot": octomap_ot,
    "PointCloud2": point_cloud,
    "OccupancyGrid 800 x 800": occupancy_grid,
    "telemetry (JSON)": telemetry,
    "JPEG": jpeg,
    "compressed": compressed,
}


def topic(way: str) -> Topic:
    return Topic("map", priority=8, compression=way == "zstd", delta=way == "delta", destinations=("base",))


def carry(
    payloads: list[bytes], config: Topic, period_s: float, tail_s: float, channel: RadioChannel | None = None
) -> dict[str, Any]:
    """Send the versions from robot to base. Figures per version."""
    sent_at: dict[bytes, float] = {}
    delays: list[float] = []
    wrong = 0

    def on_event(now: float, robot: str, event: Event) -> None:
        nonlocal wrong
        if robot != "base" or not isinstance(event, MessageReceived):
            return
        at = sent_at.get(bytes(event.payload))
        wrong += at is None
        if at is not None:
            delays.append(now - at)

    settings = {name: Settings(name, unkeyed=True, topics=(config,)) for name in ("robot", "base")}
    radio = channel or RadioChannel()
    team = Team(settings, channel=radio, loss=lambda a, b, now: 0.05, seed=1, on_event=on_event)
    team.event_queue.run_until(5.0)
    before_bytes, before_s = team.medium.counts.bytes, time.process_time()
    for payload in payloads:
        sent_at[payload] = team.event_queue.now
        team.send("robot", "map", payload)
        team.event_queue.run_until(team.event_queue.now + period_s)
    team.event_queue.run_until(team.event_queue.now + tail_s)
    count = len(payloads)
    return {
        "arrived": len(delays),
        "wrong": wrong,
        "bytes": (team.medium.counts.bytes - before_bytes) / count,
        "cpu_ms": (time.process_time() - before_s) * 1000 / count,
        "latency_s": sorted(delays)[len(delays) // 2] if delays else float("nan"),
    }


def full_maps(minutes: float) -> list[bytes]:
    """A map every 10 s as a fully explored mine has it at 5.4 GB an hour: 15 MB, of which a little changes."""
    rng = random.Random(16)
    record = [rng.randbytes(12) for _ in range(5000)]
    cloud = bytearray(b"".join(rng.choice(record) + rng.randbytes(4) for _ in range(15_000_000 // 16)))
    made = []
    for _ in range(round(minutes * 60 / PERIOD_S)):
        cloud += b"".join(rng.choice(record) + rng.randbytes(4) for _ in range(6000))
        for _ in range(200):
            at = rng.randrange(len(cloud) // 16) * 16
            cloud[at : at + 16] = rng.choice(record) + rng.randbytes(4)
        made.append(bytes(cloud))
    return made


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--versions", type=int, default=20)
    parser.add_argument("--minutes", type=float, default=3.0, help="of full maps")
    arguments = parser.parse_args()
    print("| data | version | way | bytes per version | processor per version (ms) | median latency (s) | arrived |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for name, make in KINDS.items():
        payloads = make(arguments.versions, random.Random(3))
        size = sum(map(len, payloads)) // len(payloads)
        for way in WAYS:
            found = carry(payloads, topic(way), PERIOD_S, 10.0)
            print(
                f"| {name} | {size:,} B | {way} | {found['bytes']:,.0f} | {found['cpu_ms']:.1f} "
                f"| {found['latency_s']:.3f} | {found['arrived']} of {len(payloads)}, {found['wrong']} wrong |",
                flush=True,
            )
    maps = full_maps(arguments.minutes)
    print("\n| full maps | maps of 15 MB | arrived | wrong | Mbit/s on the air | median latency (s) |")
    print("| --- | --- | --- | --- | --- | --- |")
    for way in ("plain", "delta"):
        config = Topic(
            "map", keep_last=1, delta=way == "delta", delta_bytes=64 << 20, destinations=("base",), priority=8
        )
        found = carry(maps, config, PERIOD_S, 0.0, RadioChannel(rate=10e6))
        rate = found["bytes"] * 8 / PERIOD_S / 1e6
        print(
            f"| {way} | {len(maps)} | {found['arrived']} | {found['wrong']} | {rate:.2f} | {found['latency_s']:.2f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
