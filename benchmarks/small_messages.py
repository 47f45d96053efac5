"""Many small messages: 10 bytes on each of 100 topics, 2,000 and 10,000 in all a second, udp_mesh and Zenoh in turn.

    python -m benchmarks.small_messages [--runs N] [--fill]

Both ends are processes of their own on a veth pair. `wire` counts everything on it in both directions, Ethernet headers
included, per byte of payload; `core` is processor time per second of wall clock.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import statistics
import struct
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from typing import Any

from benchmarks.link.laboratory import INTERFACE, Wire, wire
from benchmarks.page import fill
from benchmarks.peers.end import cpu_s, say_ready
from benchmarks.tables import row
from benchmarks.trial import percentile

TOPICS = 100
RATES = (2_000, 10_000)
SECONDS = 8.0
PEERS = ("udp_mesh", "Zenoh (TCP)")
MESSAGE = struct.Struct(">dH")
"""When it was sent, and its topic: 10 bytes."""
PORT = 7447
_TICK_S = 0.0005
_READY_S = 30.0
_LINGER_S = 0.5


@asynccontextmanager
async def _udp_mesh_node(name: str) -> Any:
    from udp_mesh import Key, Node, Settings, Topic

    topics = tuple(Topic(f"topic{number}", priority=5) for number in range(TOPICS))
    async with Node(Settings(name, keys=(Key.parse("be" * 32),), topics=topics)) as node:
        yield node


@asynccontextmanager
async def _udp_mesh_sender(_: str) -> Any:
    async with _udp_mesh_node("sender") as node:
        async with asyncio.timeout(_READY_S):
            while not any(peer.name == "receiver" and peer.online for peer in node.conditions().peers):  # noqa: ASYNC110
                await asyncio.sleep(0.05)

        async def send(topic: int, data: bytes) -> None:
            await node.send(f"topic{topic}", data, to="receiver")

        yield send


@asynccontextmanager
async def _udp_mesh_receiver(on_message: Callable[[bytes], None]) -> Any:
    async with _udp_mesh_node("receiver") as node:

        async def read() -> None:
            async for received in node.messages():
                on_message(received.payload)

        reading = asyncio.create_task(read())
        yield
        reading.cancel()


@asynccontextmanager
async def _zenoh_sender(address: str) -> Any:
    import zenoh

    from benchmarks.peers.zenoh_tcp import open_session

    session = await asyncio.to_thread(open_session, [], [f"tcp/{address}:{PORT}"])
    publishers = [
        session.declare_publisher(
            f"topic/{number}", congestion_control=zenoh.CongestionControl.BLOCK, reliability=zenoh.Reliability.RELIABLE
        )
        for number in range(TOPICS)
    ]
    async with asyncio.timeout(_READY_S):
        while not all(publisher.matching_status.matching for publisher in publishers):  # noqa: ASYNC110
            await asyncio.sleep(0.05)

    async def send(topic: int, data: bytes) -> None:
        publishers[topic].put(data)

    yield send
    await asyncio.to_thread(session.close)


@asynccontextmanager
async def _zenoh_receiver(on_message: Callable[[bytes], None]) -> Any:
    from benchmarks.peers.zenoh_tcp import open_session

    session = await asyncio.to_thread(open_session, [f"tcp/0.0.0.0:{PORT}"], [])
    subscriber = session.declare_subscriber("topic/*", lambda sample: on_message(sample.payload.to_bytes()))
    yield
    subscriber.undeclare()
    await asyncio.to_thread(session.close)


def _sender(peer: str, address: str) -> AbstractAsyncContextManager[Any]:
    return _udp_mesh_sender(address) if peer == PEERS[0] else _zenoh_sender(address)


def _receiver(peer: str, on_message: Callable[[bytes], None]) -> AbstractAsyncContextManager[Any]:
    return _udp_mesh_receiver(on_message) if peer == PEERS[0] else _zenoh_receiver(on_message)


async def _send(peer: str, address: str, rate: int) -> dict[str, Any]:
    async with _sender(peer, address) as send:
        say_ready()
        await asyncio.to_thread(sys.stdin.readline)
        began_cpu_s, began_s = cpu_s(), time.monotonic()
        number = 0
        while (now := time.monotonic()) < began_s + SECONDS:
            due = int((now - began_s) * rate)
            while number < due:
                await send(number % TOPICS, MESSAGE.pack(time.monotonic(), number % TOPICS))
                number += 1
            await asyncio.sleep(_TICK_S)
        used_s, took_s = cpu_s() - began_cpu_s, time.monotonic() - began_s
        await asyncio.sleep(_LINGER_S)
        return {"sent": number, "core": used_s / took_s}


async def _receive(peer: str) -> dict[str, Any]:
    latencies: list[float] = []

    def on_message(data: bytes) -> None:
        sent_at, _ = MESSAGE.unpack(data)
        latencies.append(time.monotonic() - sent_at)

    async with _receiver(peer, on_message):
        say_ready()
        began_cpu_s = cpu_s()
        await asyncio.to_thread(sys.stdin.readline)
        core = (cpu_s() - began_cpu_s) / SECONDS
    latencies.sort()
    p50_s, p99_s = percentile(latencies, 0.5), percentile(latencies, 0.99)
    return {"received": len(latencies), "core": core, "p50_s": p50_s, "p99_s": p99_s}


def _start(lab: Wire, host: int, *arguments: str) -> subprocess.Popen[str]:
    command = lab.inside(host, [sys.executable, "-m", "benchmarks.small_messages", "--end", *arguments])
    return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)


def _on_the_wire(lab: Wire) -> int:
    counters = f"/sys/class/net/{INTERFACE}/statistics"
    return sum(int(lab.run(0, ["cat", f"{counters}/{which}_bytes"])) for which in ("tx", "rx"))


def measure(lab: Wire, peer: str, rate: int) -> dict[str, Any]:
    """One run. Raises RuntimeError when an end fails."""
    receiver = _start(lab, 1, "receive", peer)
    sender = _start(lab, 0, "send", peer, lab.addresses[1], str(rate))
    try:
        for end in (receiver, sender):
            assert end.stdout is not None
            if end.stdout.readline() != "ready\n":
                raise RuntimeError(f"{peer}: an end did not start")
        before = _on_the_wire(lab)
        sent = json.loads(sender.communicate("go\n")[0])
        bytes_on_wire = _on_the_wire(lab) - before
        received = json.loads(receiver.communicate("end\n")[0])
    finally:
        for end in (receiver, sender):
            end.kill()
            end.wait()
    return {
        "peer": peer,
        "rate": rate,
        "carried": received["received"] / sent["sent"],
        "offered": sent["sent"] / (rate * SECONDS),
        "wire": bytes_on_wire / (sent["sent"] * MESSAGE.size),
        "sender": sent["core"],
        "receiver": received["core"],
        "p50_s": received["p50_s"],
        "p99_s": received["p99_s"],
    }


COLUMNS = ("offered", "carried", "wire", "sender", "receiver", "p50_s", "p99_s")


def report(results: list[dict[str, Any]]) -> str:
    titles = ["sent", "arrived", "wire bytes per byte", "core: sender", "receiver", "p50", "p99"]
    lines = [row(["messages/s", "transport", *titles]), row(["---"] * 9)]
    for rate in RATES:
        for peer in PEERS:
            runs = [result for result in results if result["peer"] == peer and result["rate"] == rate]
            sent, arrived, on_wire, sender, receiver, p50_s, p99_s = (
                statistics.median(run[column] for run in runs) for column in COLUMNS
            )
            cores = [f"{sender:.2f}", f"{receiver:.2f}"]
            latencies = [f"{seconds * 1000:.1f} ms" for seconds in (p50_s, p99_s)]
            lines.append(
                row([f"{rate:,}", peer, f"{sent:.1%}", f"{arrived:.1%}", f"{on_wire:.1f}", *cores, *latencies])
            )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.small_messages", description=__doc__)
    parser.add_argument("--runs", type=int, default=3, help="number of runs of each; the table shows the medians")
    parser.add_argument("--fill", action="store_true", help="write the table to docs/benchmarks.md")
    parser.add_argument("--end", nargs="+", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.end:
        role, peer, *rest = arguments.end
        work = _receive(peer) if role == "receive" else _send(peer, rest[0], int(rest[1]))
        print(json.dumps(asyncio.run(work)))
        return
    results = []
    with wire() as lab:
        for number in range(1, arguments.runs + 1):
            for rate in RATES:
                for peer in PEERS:
                    print(f"[{number}/{arguments.runs}] {rate}/s {peer}", file=sys.stderr, flush=True)
                    results.append(measure(lab, peer, rate))
                    print(json.dumps(results[-1]), file=sys.stderr, flush=True)
    text = report(results)
    print(text)
    if arguments.fill:
        fill("small messages", text)


if __name__ == "__main__":
    main()
