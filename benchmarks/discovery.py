"""Growth of discovery with the team: `python -m benchmarks.discovery [--nodes 2,10,50,200,1000]`.

Every robot runs the transport's core in virtual time; all hear each other without loss, which is the worst case for
discovery: each broadcast reaches every robot. They share one 20 Mbit/s channel, one datagram at a time.

1. The robots are powered on within two seconds; measured is the time until all know each other.
2. *idle*: only discovery traffic. *busy*: each robot reports to the base five times a second, so that traffic already
   proves those links. Measured are the datagrams of a robot other than the base, and the channel share of broadcasts.
3. The team is split in two until both halves have reported each other offline; measured is the time from the end of
   the cut until all know each other again.
"""

from __future__ import annotations

import argparse
import functools
import gc
import random
import time
from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks.page import append_result, read_results
from udp_mesh.core import receive
from udp_mesh.core.endpoint import Endpoint
from udp_mesh.core.events import PeerOffline, PeerOnline
from udp_mesh.core.interfaces import Datagram
from udp_mesh.core.settings import LinkInfo, LinkKind, Settings, Topic
from udp_mesh.crypto import channel
from udp_mesh.sim.event_queue import SimEventQueue

# All receivers of a broadcast decrypt it with one key and decode the same bytes to the same frozen frames: cached, one
# CPU can simulate 1,000 robots that know each other, within its memory.
receive.decode = functools.lru_cache(maxsize=64)(receive.decode)  # type: ignore[attr-defined]
receive.parse_header = functools.lru_cache(maxsize=64)(receive.parse_header)  # type: ignore[assignment, attr-defined]
channel.AESGCM = functools.lru_cache(maxsize=4096)(channel.AESGCM)  # type: ignore[assignment, attr-defined]

RESULTS = Path(__file__).with_name("results") / "discovery.jsonl"
LINK = "mesh0"
IP_UDP_BYTES = 28
CHANNEL_BITS_PER_S = 20e6
TRANSMISSION_S = 0.0001
"""Preamble, spacing and acknowledgment of a radio."""
TELEMETRY_S = 0.2
POWER_ON_SPREAD_S = 2.0
MAX_DURATION_S = 900.0
"""A team that has not discovered itself by then never will."""


class OpenField:
    """A team of robots that all hear each other; `cut` separates even-numbered from odd-numbered robots."""

    def __init__(self, count: int) -> None:
        self.event_queue = SimEventQueue()
        self.known_pairs = 0
        """Ordered pairs of robots of which the first reports the second online."""
        self.cut = False
        self.busy = False
        self.sent = [[0, 0] for _ in range(count)]
        self.broadcast_s = 0.0
        self.busiest_second_s = 0.0
        self._second: deque[tuple[float, float]] = deque()
        self._second_s = 0.0
        self._free_at = 0.0
        self._arrived: set[int] = set()
        self._is_on = [False] * count
        rng = random.Random(1)
        self.addresses = [(f"10.0.{index // 250}.{index % 250 + 1}", 8700) for index in range(count)]
        self._by_address = {address: index for index, address in enumerate(self.addresses)}
        topics = (Topic("telemetry", priority=3, reliable=False),)
        self.nodes = [
            Endpoint(
                Settings(f"robot{index:04}", unkeyed=True, topics=topics), boot_id=rng.randbytes(16),
                rng=random.Random(index), now=0.0,
            )
            for index in range(count)
        ]  # fmt: skip
        self._wake_s = [float("inf")] * count
        for index, node in enumerate(self.nodes):
            node.link_up(LinkInfo(LINK, LinkKind.BROADCAST, self.addresses[index], ("10.0.255.255", 8700)), 0.0)
            self.event_queue.at(rng.random() * POWER_ON_SPREAD_S, partial(self._switch_on, index))

    @property
    def all_pairs(self) -> int:
        return len(self.nodes) * (len(self.nodes) - 1)

    def report(self, index: int) -> None:
        """Send telemetry to the base from now on."""
        if self.busy:
            self.nodes[index].send("telemetry", bytes(200), destination="robot0000", now=self.event_queue.now)
            self._settle(index)
            self.event_queue.after(TELEMETRY_S, partial(self.report, index))

    def run_until_known(self, pairs: Callable[[int], bool]) -> float | None:
        """Run until the number of known pairs satisfies `pairs`; returns the time this took."""
        begun = self.event_queue.now
        while not pairs(self.known_pairs):
            if self.event_queue.now - begun > MAX_DURATION_S:
                return None
            self.event_queue.run_until(self.event_queue.now + 0.05)
        return self.event_queue.now - begun

    def _switch_on(self, index: int) -> None:
        self._is_on[index] = True
        self.nodes[index].handle_timer(self.event_queue.now)
        self._settle(index)

    def _settle(self, index: int) -> None:
        node, now = self.nodes[index], self.event_queue.now
        while datagrams := node.datagrams_to_send(now):
            for datagram in datagrams:
                self._transmit(index, datagram)
        while (event := node.next_event()) is not None:
            match event:
                case PeerOnline():
                    self.known_pairs += 1
                case PeerOffline():
                    self.known_pairs -= 1
                case _:
                    pass
        timer_s = node.next_timer()
        if timer_s is not None and timer_s < self._wake_s[index]:
            self._wake_s[index] = max(timer_s, now + 1e-6)
            self.event_queue.at(self._wake_s[index], partial(self._wake, index))

    def _transmit(self, index: int, datagram: Datagram) -> None:
        size = len(datagram.data) + IP_UDP_BYTES
        took_s = size * 8 / CHANNEL_BITS_PER_S + TRANSMISSION_S
        self._free_at = max(self._free_at, self.event_queue.now) + took_s
        self.sent[index][0] += 1
        self.sent[index][1] += size
        to = self._by_address.get(datagram.destination) if datagram.destination else None
        targets: Sequence[int]
        if to is None:
            self._count_broadcast(took_s)
            targets = range(len(self.nodes))
        else:
            targets = (to,)
        self.event_queue.at(self._free_at, partial(self._arrive, targets, datagram.data, index))

    def _count_broadcast(self, took_s: float) -> None:
        self.broadcast_s += took_s
        self._second.append((self._free_at, took_s))
        self._second_s += took_s
        while self._second[0][0] < self._free_at - 1.0:
            self._second_s -= self._second.popleft()[1]
        self.busiest_second_s = max(self.busiest_second_s, self._second_s)

    def _arrive(self, targets: Sequence[int], data: bytes, source: int) -> None:
        now, address, nodes = self.event_queue.now, self.addresses[source], self.nodes
        for index in targets:
            if index != source and self._is_on[index] and not (self.cut and (index ^ source) & 1):
                nodes[index].receive(data, LINK, address, now)
                if len(targets) == 1:
                    self._settle(index)
                elif nodes[index].next_timer() != self._wake_s[index] and index not in self._arrived:
                    # after a batch of datagrams, as a driver does
                    self._arrived.add(index)
                    self.event_queue.after(0.005, partial(self._look, index))

    def _look(self, index: int) -> None:
        self._arrived.discard(index)
        self._settle(index)

    def _wake(self, index: int) -> None:
        if self.event_queue.now >= self._wake_s[index]:
            self._wake_s[index] = float("inf")
            self.nodes[index].handle_timer(self.event_queue.now)
            self._settle(index)


def measure(count: int) -> dict[str, Any]:
    """All figures for a team of one size; rates are those of robots other than the base."""
    begun = time.process_time()
    gc.disable()
    field = OpenField(count)
    met_s = field.run_until_known(lambda pairs: pairs == field.all_pairs)
    gc.collect()
    result: dict[str, Any] = {"nodes": count, "met_s": met_s, "meeting_busiest_share": field.busiest_second_s}
    # the heartbeat interval of a large team is long: count over one interval
    count_s = max(10.0, count / 30)
    field.event_queue.run_until(field.event_queue.now + 5.0)
    result["idle"] = _rates(field, count_s)
    field.busy = True
    rng = random.Random(2)
    for index in range(1, count):
        field.event_queue.after(rng.random() * TELEMETRY_S, partial(field.report, index))
    field.event_queue.run_until(field.event_queue.now + 5.0)
    result["busy"] = _rates(field, 10.0)
    field.busy = False
    field.cut = True
    across = 2 * (count // 2) * ((count + 1) // 2)
    result["offline_s"] = field.run_until_known(lambda pairs: pairs == field.all_pairs - across)
    field.cut = False
    field.busiest_second_s = 0.0
    result["healed_s"] = field.run_until_known(lambda pairs: pairs == field.all_pairs)
    result["healing_busiest_share"] = field.busiest_second_s
    result["processor_s"] = time.process_time() - begun
    gc.enable()
    gc.collect()
    return result


def _rates(field: OpenField, count_s: float) -> dict[str, float]:
    before = [tuple(sent) for sent in field.sent[1:]]
    broadcast_before = field.broadcast_s
    field.event_queue.run_until(field.event_queue.now + count_s)
    datagrams = sum(now[0] - then[0] for now, then in zip(field.sent[1:], before, strict=True))
    size = sum(now[1] - then[1] for now, then in zip(field.sent[1:], before, strict=True))
    robots = len(field.nodes) - 1
    reports = robots * count_s / TELEMETRY_S if field.busy else 0.0
    return {
        "datagrams_per_s": (datagrams - reports) / (robots * count_s),
        "bytes_per_s": size / (robots * count_s),
        "broadcast_channel_share": (field.broadcast_s - broadcast_before) / count_s,
    }


def table(results: Sequence[dict[str, Any]]) -> str:
    lines = [
        "| robots | all know all after, s | busiest second of it | idle: bytes per robot and s "
        "| idle: broadcasts' share | busy: datagrams besides telemetry, per robot and s "
        "| busy: bytes in all, per robot and s | busy: broadcasts' share | known again after a cut, s "
        "| busiest second of that |",
        "| --- " * 10 + "|",
    ]
    for result in results:
        idle, busy = result["idle"], result["busy"]
        lines.append(
            f"| {result['nodes']} | {_seconds(result['met_s'])} | {result['meeting_busiest_share']:.1%} "
            f"| {idle['bytes_per_s']:.0f} | {idle['broadcast_channel_share']:.2%} | {busy['datagrams_per_s']:.2f} "
            f"| {busy['bytes_per_s']:.0f} | {busy['broadcast_channel_share']:.2%} "
            f"| {_seconds(result['healed_s'])} | {result['healing_busiest_share']:.1%} |"
        )
    return "\n".join(lines)


def _seconds(value: float | None) -> str:
    return "never" if value is None else f"{value:.1f}"


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.discovery", description=__doc__)
    parser.add_argument(
        "--nodes", default="2,10,50,200,1000", help="team sizes; 1,000 takes some gigabytes and tens of minutes"
    )
    parser.add_argument(
        "--results", type=Path, default=RESULTS, help="file of results; sizes it already has are not run again"
    )
    arguments = parser.parse_args()
    arguments.results.parent.mkdir(parents=True, exist_ok=True)
    results = {read_result["nodes"]: read_result for read_result in read_results(arguments.results)}
    for word in arguments.nodes.split(","):
        if int(word) not in results:
            results[int(word)] = measured = measure(int(word))
            append_result(arguments.results, measured)
    print(table([result for _, result in sorted(results.items())]))


if __name__ == "__main__":
    main()
