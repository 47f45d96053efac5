"""Latency of urgent messages under floods of forged datagrams: `python -m benchmarks.flood [--rounds 3] [--fill]`.

A daemon receives 200-byte urgent messages at 100 Hz from a library node while an attacker at a third address sends
datagrams of one kind without the key: at no rate, at 20,000 and at 100,000 a second, in turn. As a control the same
flood goes to a closed port, which shows what the machine itself loses. Only the ratio to the quiet phase of the same
round says something about the daemon. Everything is on the loopback.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import random
import socket
import statistics
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.link.laboratory import compiled
from benchmarks.page import fill
from benchmarks.tables import row
from benchmarks.trial import percentile
from udp_mesh import Key, LinkConfig, Neighbour, Node, SendRefusedError, Settings, Topic
from udp_mesh.client import MeshClient, MeshError
from udp_mesh.wire.header import Kind, encode_long

RESULTS = Path(__file__).with_name("results") / "flood.jsonl"
SOURCE = Path(__file__).parent / "link" / "flood.c"
SENDER, VICTIM, ATTACKER = "127.0.7.1", "127.0.7.2", "127.0.7.66"
RATES = (0, 20_000, 100_000)
HZ = 100.0
MESSAGE_BYTES = 200
FLOOD_BYTES = 120
SETTLE_S = 0.5
"""After the start of a flood, before latencies count."""
KEY = Key.parse("be" * 32)

_CONFIGURATION = """
name = "victim"
port = {port}
key_file = "{folder}/key"
[[links]]
address = "{victim}"
kind = "neighbours"
[[neighbours]]
address = "{sender}"
[[neighbours]]
address = "{attacker}"
name = "old"
legacy = true
[topics]
urgent = {{ priority = 0 }}
[daemon]
socket = "{folder}/socket"
state_directory = "{folder}/state"
"""


@dataclass(frozen=True, slots=True)
class Flood:
    """One kind: the first bytes of its datagrams (the rest is random), and whether they go to a closed port."""

    name: str
    prefix: bytes
    closed_port: bool = False


def kinds(tag: int) -> list[Flood]:
    """`tag` is that of the channel from the sender to the victim: it is in clear in every datagram."""
    dead_boot = encode_long(Kind.HELLO, KEY.key_id, random.Random(1).randbytes(16), 7)
    return [
        Flood("control: closed port", b"", closed_port=True),
        Flood("unknown tag", b"\x93"),
        Flood("random bytes", b""),
        Flood("legacy fragments, configured address", b"\x01"),
        Flood("valid check of a dead boot, garbage", dead_boot + KEY.check(dead_boot)),
        Flood("right tag, garbage", struct.pack(">BH", 0x93, tag)),
        Flood("hello, unknown key", b"\x90"),
    ]


class Victim:
    """A running daemon and a program that reads its urgent messages."""

    def __init__(self, folder: Path, port: int) -> None:
        self.port = port
        self.log = folder / "log"
        (folder / "key").write_text(KEY.secret.hex())
        (folder / "key").chmod(0o600)
        text = _CONFIGURATION.format(folder=folder, port=port, victim=VICTIM, sender=SENDER, attacker=ATTACKER)
        (folder / "victim.toml").write_text(text)
        command = [sys.executable, "-m", "udp_mesh.cli.main", "run", str(folder / "victim.toml")]
        with self.log.open("wb") as log:
            self.process = subprocess.Popen(command, stdout=log, stderr=log)
        self.latencies: list[float] = []
        self._socket = str(folder / "socket")
        self._client = self._connect()
        self._client.subscribe("urgent")
        threading.Thread(target=self._read, daemon=True).start()

    def _connect(self) -> MeshClient:
        until = time.monotonic() + 30.0
        while True:
            try:
                return MeshClient(self._socket)
            except MeshError:
                if time.monotonic() > until:
                    raise
                time.sleep(0.1)

    def _read(self) -> None:
        # The daemon closes the connection when it ends.
        with suppress(MeshError):
            for message in self._client.messages():
                self.latencies.append(time.monotonic() - struct.unpack_from("d", message.payload)[0])

    def memory_bytes(self) -> int:
        fields = Path(f"/proc/{self.process.pid}/statm").read_text().split()
        return int(fields[1]) * os.sysconf("SC_PAGE_SIZE")

    def cpu_s(self) -> float:
        fields = Path(f"/proc/{self.process.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def close(self) -> None:
        self.process.terminate()
        self.process.wait()


def _free_port() -> int:
    with socket.socket(type=socket.SOCK_DGRAM) as probe:
        probe.bind((VICTIM, 0))
        return int(probe.getsockname()[1])


@contextmanager
def victim() -> Iterator[Victim]:
    # A Unix socket's path has at most 107 bytes.
    with tempfile.TemporaryDirectory(prefix="flood-") as path:
        running = Victim(Path(path), _free_port())
        try:
            yield running
        finally:
            running.close()


async def _send_for(node: Node, seconds: float) -> int:
    """Send at `HZ`; returns the number sent."""
    sent, at = 0, time.monotonic()
    until = at + seconds
    while at < until:
        at += 1 / HZ
        await asyncio.sleep(max(0.0, at - time.monotonic()))
        payload = struct.pack("d", time.monotonic()).ljust(MESSAGE_BYTES, b"\0")
        try:
            await node.send("urgent", payload, to="victim")
        except SendRefusedError:
            continue
        sent += 1
    return sent


async def _phase(
    node: Node, attacked: Victim, flood: Flood, rate: int, seconds: float, program: Path
) -> dict[str, Any]:
    attacker = None
    if rate:
        port = _free_port() if flood.closed_port else attacked.port
        source_rate_seconds = (ATTACKER, VICTIM, str(port), str(rate), str(seconds + SETTLE_S))
        attacker = subprocess.Popen(  # noqa: ASYNC220
            [str(program), *source_rate_seconds, str(FLOOD_BYTES), flood.prefix.hex()], stdout=subprocess.PIPE
        )
        await _send_for(node, SETTLE_S)
    log_before, cpu_before = attacked.log.stat().st_size, attacked.cpu_s()
    attacked.latencies.clear()
    sent = await _send_for(node, seconds)
    cpu = (attacked.cpu_s() - cpu_before) / seconds
    await asyncio.sleep(1.0)
    latencies = sorted(attacked.latencies)
    flooded = int(attacker.communicate()[0]) / (seconds + SETTLE_S) if attacker is not None else 0.0
    return {
        "kind": flood.name, "rate": rate, "sent_per_s": flooded, "arrived": len(latencies) / sent,
        "p50_s": percentile(latencies, 0.5), "p99_s": percentile(latencies, 0.99), "cpu": cpu,
        "log_bytes": attacked.log.stat().st_size - log_before, "memory_bytes": attacked.memory_bytes(),
    }  # fmt: skip


async def _round(seconds: float, program: Path, only: str) -> list[dict[str, Any]]:
    results = []
    with victim() as attacked:
        settings = Settings(
            "sender", keys=(KEY,), topics=(Topic("urgent", priority=0),), port=attacked.port,
            neighbours=(Neighbour((VICTIM, attacked.port)),),
        )  # fmt: skip
        async with Node(settings, links=(LinkConfig(address=SENDER, broadcast=False),)) as node:
            async with asyncio.timeout(60):
                while not any(peer.online for peer in node.conditions().peers):  # noqa: ASYNC110
                    await asyncio.sleep(0.1)
            await _send_for(node, 2.0)
            session = node.driver.node._state.peer_table.peers["victim"].session
            assert session is not None
            for flood in kinds(session.path.channel.tag):
                if only not in flood.name:
                    continue
                for rate in RATES:
                    results.append(await _phase(node, attacked, flood, rate, seconds, program))
                    print(results[-1], file=sys.stderr, flush=True)
                    await _send_for(node, 1.0)
    return results


def table(results: list[dict[str, Any]]) -> str:
    """Medians over the rounds; ratios are taken within a round."""
    lines = [
        row(["flood", "per second", "urgent p50, ms", "urgent p99, ms", "p99 / quiet", "arrived", "daemon, cores",
             "log, lines of 100 B"]),
        row(["---"] * 8),
    ]  # fmt: skip
    ratios = {rate: ratio_by_kind(results, rate) for rate in RATES[1:]}
    for kind in dict.fromkeys(result["kind"] for result in results):
        for rate in RATES:
            runs = [result for result in results if (result["kind"], result["rate"]) == (kind, rate)]

            def middle(figure: str, runs: list[dict[str, Any]] = runs) -> float:
                return float(statistics.median(run[figure] for run in runs))

            ratio = f"{statistics.median(ratios[rate][kind]):.2f}" if rate else ""
            lines.append(
                row([kind, f"{rate:,}" if rate else "quiet", f"{1e3 * middle('p50_s'):.1f}",
                     f"{1e3 * middle('p99_s'):.1f}", ratio, f"{middle('arrived'):.0%}", f"{middle('cpu'):.2f}",
                     f"{middle('log_bytes') / 100:.0f}"])
            )  # fmt: skip
    return "\n".join(lines)


def ratio_by_kind(results: list[dict[str, Any]], rate: int) -> dict[str, list[float]]:
    """Kind -> p99 in multiples of the quiet phase before it, one per round."""
    ratios: dict[str, list[float]] = {}
    quiet: dict[str, float] = {}
    for result in results:
        if not result["rate"]:
            quiet[result["kind"]] = result["p99_s"]
        elif result["rate"] == rate:
            ratios.setdefault(result["kind"], []).append(result["p99_s"] / quiet[result["kind"]])
    return ratios


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.flood", description=__doc__)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=8.0, help="length of each phase")
    parser.add_argument("--only", default="", help="kinds whose names contain this")
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--fill", action="store_true", help="write the table to docs/benchmarks.md")
    arguments = parser.parse_args()
    results: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as path:
        program = compiled(SOURCE, Path(path))
        for _ in range(arguments.rounds):
            results += asyncio.run(_round(arguments.seconds, program, arguments.only))
    arguments.results.write_text("".join(json.dumps(result) + "\n" for result in results))
    print(table(results))
    if arguments.fill:
        fill("flood", table(results))


if __name__ == "__main__":
    main()
