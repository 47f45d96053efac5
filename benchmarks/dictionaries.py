"""Trained dictionaries against the last version as dictionary; and how long a large base holds up a node's loop.

    python -m benchmarks.dictionaries

First table: body bytes per message of small messages of a kind (generated from a seed), by zstd at the transport's
level: alone; with a dictionary of 8 KiB trained on 400 other messages of that kind; with the message before it as
prefix, as `delta` does. Second table: the longest time in which a loop did nothing else, urgent messages included,
while a version of 1 MiB was encoded as a difference to a base: with the base copied and indexed on the loop, and in the
daemon's background thread. Of five runs the least, in turns; `idle` is the loop without any of this.
"""

from __future__ import annotations

import asyncio
import itertools
import json
import math
import random
import struct
import sys
from collections.abc import Callable, Iterator
from hashlib import blake2b

from udp_mesh.core.interfaces import in_foreground
from udp_mesh.core.versions.encoding import Version, VersionEncoding
from udp_mesh.core.zstd import LEVEL, ZstdCompression
from udp_mesh.daemon.background import BackgroundThread
from udp_mesh.wire.version import HASH_BYTES

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

DICTIONARY_BYTES = 8192
MESSAGES = 400
BASE_MIB = (1, 4, 16, 64)
RUNS = 5
IDLE_S = 0.1
OVERHEAD_BYTES = 58
"""Header, seal and fragment of a message that fits a datagram."""


def position(rng: random.Random) -> Iterator[bytes]:
    """A pose as JSON."""
    x = y = heading = 0.0
    for number in range(MESSAGES):
        heading += rng.gauss(0, 0.1)
        x, y = x + math.cos(heading), y + math.sin(heading)
        yield json.dumps({"t": number / 10, "x": round(x, 2), "y": round(y, 2), "heading": round(heading, 3)}).encode()


def odometry(rng: random.Random) -> Iterator[bytes]:
    """nav_msgs/Odometry as ROS serializes it: header, pose and twist of doubles, covariances."""
    x = 0.0
    for number in range(MESSAGES):
        x += rng.gauss(0.05, 0.01)
        head = struct.pack("<III", number, 1_700_000_000 + number // 10, number % 10 * 100_000_000)
        frames = b"".join(struct.pack("<I", len(name)) + name for name in (b"odom", b"base_link"))
        pose = struct.pack("<7d", x, rng.gauss(0, 0.01), 0.0, 0.0, 0.0, 0.0, 1.0)
        twist = struct.pack("<6d", rng.gauss(0.5, 0.1), 0.0, 0.0, 0.0, 0.0, rng.gauss(0, 0.1))
        covariance = struct.pack("<36d", *(0.01 if entry % 7 == 0 else 0.0 for entry in range(36)))
        yield head + frames + pose + covariance + twist + covariance


def health(rng: random.Random) -> Iterator[bytes]:
    """Battery, temperatures and states of 20 devices as JSON."""
    values = [rng.uniform(20, 60) for _ in range(20)]
    for _ in range(MESSAGES):
        values = [value + rng.gauss(0, 0.2) for value in values]
        devices = [
            {"device": f"motor{number}", "temperature_c": round(value, 1), "state": "ok" if value < 70 else "hot"}
            for number, value in enumerate(values)
        ]
        yield json.dumps({"battery": round(rng.uniform(0.2, 1.0), 3), "devices": devices}).encode()


def artifact(rng: random.Random) -> Iterator[bytes]:
    """Reports that have nothing to do with the one before."""
    kinds = ("survivor", "backpack", "rope", "helmet", "drill", "extinguisher", "vent", "cube", "gas", "phone")
    for number in range(MESSAGES):
        place = [round(rng.uniform(-500, 500), 2) for _ in range(3)]
        report = {"id": number, "kind": rng.choice(kinds), "confidence": round(rng.random(), 3), "position_m": place}
        yield json.dumps({"type": "artifact_report", "source": f"husky{rng.randint(1, 3)}", "report": report}).encode()


KINDS: dict[str, Callable[[random.Random], Iterator[bytes]]] = {
    "position (JSON)": position,
    "odometry (ROS)": odometry,
    "health (JSON)": health,
    "artifact report (JSON)": artifact,
}


def body_bytes(content: bytes, prefix: bytes | None) -> int:
    """What the transport would send: compressed, or as it is."""
    compression = ZstdCompression(content, len(content), prefix)
    while not compression.step():
        pass
    return len(content) if compression.body is None else len(compression.body)


def with_dictionary(content: bytes, dictionary: zstd.ZstdDict) -> int:
    return min(len(content), len(zstd.compress(content, level=LEVEL, zstd_dict=dictionary)))


async def standstill_s(payload: bytes, base: Version | None, *, in_thread: bool) -> float:
    """The longest time between two turns of a loop that encodes a version (without a base: that does nothing)."""
    loop = asyncio.get_running_loop()
    turns_s = [loop.time()]

    async def turn() -> None:
        while True:
            await asyncio.sleep(0)
            turns_s.append(loop.time())

    turning = asyncio.create_task(turn())
    thread = BackgroundThread(loop, lambda: None)
    background = thread if in_thread else in_foreground
    if base is None:
        await asyncio.sleep(IDLE_S)
    else:
        encoding = VersionEncoding(payload, base, compression=False, background=background)
        for _ in iter(encoding.step, True):
            await asyncio.sleep(0)
    thread.close()
    turning.cancel()
    return max(later - earlier for earlier, later in itertools.pairwise(turns_s))


def standstills(mib: int) -> tuple[float, float, float]:
    """Idle, on the loop, in the thread."""
    content = random.Random(1).randbytes(mib << 20)
    base, payload = Version(blake2b(content, digest_size=HASH_BYTES).digest(), content), content[: 1 << 20]
    runs = [
        (
            asyncio.run(standstill_s(payload, None, in_thread=False)),
            asyncio.run(standstill_s(payload, base, in_thread=False)),
            asyncio.run(standstill_s(payload, base, in_thread=True)),
        )
        for _ in range(RUNS)
    ]
    idle_s, foreground_s, thread_s = (min(column) for column in zip(*runs, strict=True))
    return idle_s, foreground_s, thread_s


def main() -> None:
    print("| kind | plain | zstd | dictionary | last message | datagram, dictionary | datagram, last message |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for name, make in KINDS.items():
        dictionary = zstd.train_dict(list(make(random.Random(1))), DICTIONARY_BYTES)
        messages = list(make(random.Random(2)))
        count = len(messages) - 1
        plain = sum(map(len, messages[1:])) / count
        alone = sum(body_bytes(message, None) for message in messages[1:]) / count
        trained = sum(with_dictionary(message, dictionary) for message in messages[1:]) / count
        delta = sum(body_bytes(message, before) for before, message in itertools.pairwise(messages)) / count
        print(
            f"| {name} | {plain:.0f} | {alone:.0f} | {trained:.0f} | {delta:.0f} "
            f"| {trained + OVERHEAD_BYTES:.0f} | {delta + OVERHEAD_BYTES:.0f} |"
        )
    print()
    print("| base, MiB | idle, ms | on the loop, ms | in the background, ms |")
    print("| --- | --- | --- | --- |")
    for mib in BASE_MIB:
        print(f"| {mib} | {' | '.join(f'{1000 * value_s:.1f}' for value_s in standstills(mib))} |")


if __name__ == "__main__":
    main()
