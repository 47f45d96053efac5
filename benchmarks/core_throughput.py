"""Throughput of one CPU core: a bulk transfer between two nodes in memory, without sockets; CPU time per side.

Datagrams pass between the nodes in batches, as from a driver with segmentation offload. Time is virtual: the nodes'
CPU time is the only limit. Prints fragments/s and payload Mbit/s that one CPU core sustains on each side. With
`--small`, messages of 10 B on 100 topics at 10,000 a second of virtual time, and the CPU time per message instead. With
`--away`, as many peers are out of reach meanwhile, and half of `limits.queue_bytes` waits for them.

    python benchmarks/core_throughput.py [--megabytes 200] [--profile sender|receiver]
    python benchmarks/core_throughput.py --small [--away 200]
"""

from __future__ import annotations

import argparse
import cProfile
import pstats
import random
import time

from udp_mesh.core.endpoint import Endpoint
from udp_mesh.core.events import MessageDelivered, MessageReceived, Rejected
from udp_mesh.core.settings import LinkInfo, LinkKind, Outbox, Settings, Topic
from udp_mesh.crypto import Key

ADDRESSES = {"a": ("10.0.0.1", 8700), "b": ("10.0.0.2", 8700)}
ROUND_TRIP_S = 0.001
"""Virtual time of one exchange, as on a wired link."""

MESSAGE_BYTES = 20_000_000

SMALL_BYTES, SMALL_TOPICS = 10, 100
SMALL_TICK_S = 0.0005
"""Interval at which the application sends, as in `benchmarks.small_messages`: 5 messages each time."""
SMALL_PER_TICK = 5
SMALL_MESSAGES = 100_000

HELD_BYTES = (1_000_000, 1)
"""Messages that fill half of `limits.queue_bytes` for peers that are away: large ones, then small ones until not even
they fit."""

TOPICS = (
    Topic("bulk"),
    Topic("held", outbox=Outbox.ALL, outbox_bytes=1 << 30),
    *(Topic(f"small{number}", priority=5) for number in range(SMALL_TOPICS)),
)


def make(name: str) -> Endpoint:
    rng = random.Random(name)
    settings = Settings(name=name, keys=(Key(bytes(32)),), topics=TOPICS)
    node = Endpoint(settings, boot_id=rng.randbytes(16), rng=rng, now=0.0)
    node.link_up(LinkInfo("wire", LinkKind.BROADCAST, ADDRESSES[name], ("10.0.0.255", 8700)), 0.0)
    return node


class Meter:
    """CPU seconds spent in one node, optionally profiled."""

    def __init__(self, profile: bool) -> None:
        self.seconds = 0.0
        self.profile = cProfile.Profile() if profile else None
        self._from = 0.0

    def __enter__(self) -> None:
        if self.profile is not None:
            self.profile.enable()
        self._from = time.process_time()

    def __exit__(self, *_: object) -> None:
        self.seconds += time.process_time() - self._from
        if self.profile is not None:
            self.profile.disable()


class Pair:
    """Nodes a and b that know each other; `exchange` passes what they send."""

    def __init__(self, profile: str | None) -> None:
        self.nodes = {"a": make("a"), "b": make("b")}
        self.meters = {"a": Meter(profile == "sender"), "b": Meter(profile == "receiver")}
        self.now = 0.0
        for _ in range(2000):
            self.exchange()
            self.now += ROUND_TRIP_S
        for meter in self.meters.values():
            meter.seconds = 0.0

    def carry(self, source: str, sink: str) -> bool:
        """Pass one batch, as one system call does; False when there was none."""
        node = self.nodes[source]
        with self.meters[source]:
            timer = node.next_timer()
            if timer is not None and timer <= self.now:
                node.handle_timer(self.now)
            batch = node.datagrams_to_send(self.now)
        address = ADDRESSES[source]
        with self.meters[sink]:
            receive = self.nodes[sink].receive
            for datagram in batch:
                receive(datagram.data, "wire", address, self.now)
        return bool(batch)

    def exchange(self) -> None:
        """Pass batches in both directions until both sides are idle; each direction takes half a round trip."""
        busy = True
        while busy:
            busy = self.carry("a", "b")
            self.now += ROUND_TRIP_S / 2
            busy = self.carry("b", "a") or busy
            self.now += ROUND_TRIP_S / 2

    def print_profiles(self) -> None:
        for meter in self.meters.values():
            if meter.profile is not None:
                pstats.Stats(meter.profile).sort_stats("tottime").print_stats(30)


def fill_outboxes(node: Endpoint, away: int, now: float) -> None:
    """Send to peers that are never heard until their shares of the memory are used up."""
    for size in HELD_BYTES if away else ():
        number, payload = 0, bytes(size)
        while not isinstance(node.send("held", payload, destination=f"away{number % away}", now=now), Rejected):
            number += 1


def run_small(away: int) -> dict[str, float]:
    """Send small messages while so many peers are away; returns the CPU seconds of both sides together: to read the
    clock for each tick and side would cost as much as some messages."""
    pair = Pair(None)
    a, b = pair.nodes["a"], pair.nodes["b"]
    fill_outboxes(a, away, pair.now)
    payload = bytes(SMALL_BYTES)
    delivered = received = sent = datagrams = 0
    began_s = time.process_time()
    while delivered < SMALL_MESSAGES:
        for _ in range(SMALL_PER_TICK if sent < SMALL_MESSAGES else 0):
            a.send(f"small{sent % SMALL_TOPICS}", payload, destination="b", now=pair.now)
            sent += 1
        for node, peer, source in ((a, b, "a"), (b, a, "b")):
            timer = node.next_timer()
            if timer is not None and timer <= pair.now:
                node.handle_timer(pair.now)
            for datagram in node.datagrams_to_send(pair.now):
                datagrams += source == "a"
                peer.receive(datagram.data, "wire", ADDRESSES[source], pair.now)
        while (event := a.next_event()) is not None:
            delivered += isinstance(event, MessageDelivered)
        while (event := b.next_event()) is not None:
            received += isinstance(event, MessageReceived)
        pair.now += SMALL_TICK_S
    assert received == sent == SMALL_MESSAGES
    return {"messages": sent, "datagrams": datagrams, "seconds": time.process_time() - began_s}


def run(megabytes: int, profile: str | None) -> dict[str, float]:
    """Transfer; returns CPU seconds per side, fragments and payload bits."""
    pair = Pair(profile)
    nodes = pair.nodes
    payload = bytes(MESSAGE_BYTES)
    messages = max(1, megabytes * 1_000_000 // MESSAGE_BYTES)
    delivered = received = sent = 0
    before = nodes["a"].conditions(pair.now).counters
    started = pair.now
    while delivered < messages:
        if sent - delivered < 2 and sent < messages:
            nodes["a"].send("bulk", payload, destination="b", now=pair.now)
            sent += 1
        pair.exchange()
        pair.now += ROUND_TRIP_S / 2
        for name, kind in (("a", MessageDelivered), ("b", MessageReceived)):
            while (event := nodes[name].next_event()) is not None:
                if isinstance(event, kind):
                    if name == "a":
                        delivered += 1
                    else:
                        received += 1
        if pair.now - started > 600:
            raise SystemExit("no progress: the transfer stalled")
    assert received == messages
    after = nodes["a"].conditions(pair.now).counters
    pair.print_profiles()
    return {
        "fragments": float(after.fragments_sent - before.fragments_sent),
        "retransmitted": float(after.fragments_retransmitted - before.fragments_retransmitted),
        "acknowledgements": float(nodes["b"].conditions(pair.now).counters.acknowledgements_sent),
        "bits": 8.0 * messages * MESSAGE_BYTES,
        "sender_s": pair.meters["a"].seconds,
        "receiver_s": pair.meters["b"].seconds,
        "virtual_s": pair.now - started,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--megabytes", type=int, default=200)
    parser.add_argument("--small", action="store_true", help="small messages instead of a bulk transfer")
    parser.add_argument("--away", type=int, default=0, metavar="PEERS", help="peers out of reach, with --small")
    parser.add_argument("--profile", choices=("sender", "receiver"))
    arguments = parser.parse_args()
    if arguments.small:
        result = run_small(arguments.away)
        each_us = 1e6 * result["seconds"] / result["messages"]
        print(f"{result['messages']:.0f} messages of {SMALL_BYTES} B in {result['datagrams']:.0f} datagrams")
        print(f"{each_us:.2f} us/message, both sides together")
        return
    result = run(arguments.megabytes, arguments.profile)
    fragments = result["fragments"]
    print(
        f"{fragments:.0f} fragments, {result['retransmitted']:.0f} of them again, "
        f"{result['acknowledgements']:.0f} acknowledgements, {result['virtual_s']:.1f} s of virtual time"
    )
    for side in ("sender", "receiver"):
        seconds = result[f"{side}_s"]
        print(
            f"{side:8s} {fragments / seconds:9.0f} fragments/s  {1e6 * seconds / fragments:6.2f} us/fragment  "
            f"{result['bits'] / seconds / 1e6:7.0f} Mbit/s of payload per core"
        )


if __name__ == "__main__":
    main()
