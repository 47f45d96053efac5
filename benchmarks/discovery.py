"""Growth of discovery traffic with the team: `python -m benchmarks.discovery [--nodes 2,10,50,200,1000]`.

Every robot runs the transport's core in virtual time; all hear each other at once and without loss, which is the worst
case for discovery: each broadcast reaches everybody. Two teams of each size: an idle one, and one whose robots send
telemetry to the base five times a second, so that traffic already proves those links. Counted, once the team has met,
are the datagrams and bytes (with IP and UDP headers) that a robot other than the base sends per second besides its
telemetry, and what all heartbeats together take of a 20 Mbit/s channel.
"""

from __future__ import annotations

import argparse
import json
import random
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from udp_mesh.core.node import Node
from udp_mesh.core.settings import LinkInfo, LinkKind, Settings, Topic
from udp_mesh.sim.agenda import Agenda

RESULTS = Path(__file__).with_name("results") / "discovery.jsonl"
LINK = "mesh0"
IP_UDP_BYTES = 28
CHANNEL_BITS_PER_S = 20e6
MEET_S = 12.0
COUNT_S = 6.0
TELEMETRY_S = 0.2
_DELAY_S = 0.001


class OpenField:
    """A team in which every datagram arrives after a millisecond."""

    def __init__(self, count: int, *, busy: bool) -> None:
        self.agenda = Agenda()
        self.busy = busy
        self.sent = [[0, 0] for _ in range(count)]
        self.broadcast_bytes = 0
        rng = random.Random(1)
        self.addresses = [(f"10.0.{index // 250}.{index % 250 + 1}", 8700) for index in range(count)]
        self.by_address = {address: index for index, address in enumerate(self.addresses)}
        topics = (Topic("telemetry", priority=3, reliable=False),)
        self.nodes = [
            Node(
                Settings(f"robot{index:04}", unkeyed=True, topics=topics), boot_id=rng.randbytes(16),
                rng=random.Random(index), now=0.0,
            )
            for index in range(count)
        ]  # fmt: skip
        self.wake_s = [float("inf")] * count
        for index, node in enumerate(self.nodes):
            node.link_up(LinkInfo(LINK, LinkKind.BROADCAST, self.addresses[index], ("10.0.255.255", 8700)), 0.0)
            # robots are not switched on at one moment
            self.agenda.at(rng.random() * 2.0, partial(self.settle, index))
            if busy and index:
                self.agenda.at(MEET_S / 2 + rng.random(), partial(self.report, index))

    def report(self, index: int) -> None:
        self.nodes[index].send("telemetry", bytes(200), destination="robot0000", now=self.agenda.now)
        self.settle(index)
        self.agenda.after(TELEMETRY_S, partial(self.report, index))

    def settle(self, index: int) -> None:
        node, now = self.nodes[index], self.agenda.now
        while datagrams := node.datagrams_to_send(now):
            for datagram in datagrams:
                data = bytes(datagram.data)
                self.sent[index][0] += 1
                self.sent[index][1] += len(data) + IP_UDP_BYTES
                to = self.by_address.get(datagram.destination) if datagram.destination else None
                if to is None:
                    self.broadcast_bytes += len(data) + IP_UDP_BYTES
                targets = [to] if to is not None else [other for other in range(len(self.nodes)) if other != index]
                self.agenda.after(_DELAY_S, partial(self.arrive, targets, data, index))
        while node.next_event() is not None:
            pass
        timer_s = node.next_timer()
        if timer_s is not None and timer_s < self.wake_s[index]:
            self.wake_s[index] = max(timer_s, now + 1e-6)
            self.agenda.at(self.wake_s[index], partial(self.wake, index))

    def arrive(self, targets: Sequence[int], data: bytes, source: int) -> None:
        for index in targets:
            self.nodes[index].receive(data, LINK, self.addresses[source], self.agenda.now)
            self.settle(index)

    def wake(self, index: int) -> None:
        if self.agenda.now >= self.wake_s[index]:
            self.wake_s[index] = float("inf")
            self.nodes[index].handle_timer(self.agenda.now)
            self.settle(index)


def measure(count: int, *, busy: bool) -> dict[str, Any]:
    """Per robot and second, between `MEET_S` and `MEET_S + COUNT_S`."""
    field = OpenField(count, busy=busy)
    field.agenda.run_until(MEET_S)
    met = sum(peer.online for peer in field.nodes[-1].conditions(MEET_S).peers)
    before = [tuple(sent) for sent in field.sent[1:]]
    broadcast_before = field.broadcast_bytes
    field.agenda.run_until(MEET_S + COUNT_S)
    datagrams = sum(now[0] - then[0] for now, then in zip(field.sent[1:], before, strict=True))
    size = sum(now[1] - then[1] for now, then in zip(field.sent[1:], before, strict=True))
    reports = (count - 1) * COUNT_S / TELEMETRY_S if busy else 0.0
    per_robot_s = (count - 1) * COUNT_S
    return {
        "nodes": count,
        "busy": busy,
        "met": met,
        "datagrams_per_s": (datagrams - reports) / per_robot_s,
        "bytes_per_s": size / per_robot_s,
        "broadcast_channel_share": (field.broadcast_bytes - broadcast_before) * 8 / COUNT_S / CHANNEL_BITS_PER_S,
    }


def table(results: Sequence[dict[str, Any]]) -> str:
    lines = [
        "| robots | team | met | datagrams besides telemetry, per robot and s | bytes in all, per robot and s "
        "| broadcasts' share of 20 Mbit/s |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    lines += [
        f"| {one['nodes']} | {'busy' if one['busy'] else 'idle'} | {one['met']} | {one['datagrams_per_s']:.2f} "
        f"| {one['bytes_per_s']:.0f} | {one['broadcast_channel_share']:.2%} |"
        for one in results
    ]
    return "\n".join(lines)


def results_of(counts: Sequence[int]) -> Iterator[dict[str, Any]]:
    for count in counts:
        for busy in (False, True):
            yield measure(count, busy=busy)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.discovery", description=__doc__)
    parser.add_argument("--nodes", default="2,10,50,200,1000")
    parser.add_argument("--results", type=Path, default=RESULTS)
    arguments = parser.parse_args()
    results = []
    arguments.results.parent.mkdir(parents=True, exist_ok=True)
    with arguments.results.open("w") as file:
        for one in results_of([int(word) for word in arguments.nodes.split(",")]):
            results.append(one)
            file.write(json.dumps(one) + "\n")
            file.flush()
            print(table([one]).splitlines()[-1], flush=True)
    print(table(results))


if __name__ == "__main__":
    main()
