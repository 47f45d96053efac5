"""Throughput of one CPU core: a bulk transfer between two nodes in memory, without sockets; CPU time per side.

Datagrams pass between the nodes in batches, as from a driver with segmentation offload. Time is virtual: the nodes'
CPU time is the only limit. Prints fragments/s and payload Mbit/s that one CPU core sustains on each side.

    python benchmarks/core_throughput.py [--megabytes 200] [--profile sender|receiver]
"""

from __future__ import annotations

import argparse
import cProfile
import pstats
import random
import time

from udp_mesh.core.endpoint import Endpoint
from udp_mesh.core.events import MessageDelivered, MessageReceived
from udp_mesh.core.settings import LinkInfo, LinkKind, Settings, Topic
from udp_mesh.crypto import Key

ADDRESSES = {"a": ("10.0.0.1", 8700), "b": ("10.0.0.2", 8700)}
ROUND_TRIP_S = 0.001
"""Virtual time of one exchange, as on a wired link."""

MESSAGE_BYTES = 20_000_000


def make(name: str) -> Endpoint:
    rng = random.Random(name)
    settings = Settings(name=name, keys=(Key(bytes(32)),), topics=(Topic("bulk"),))
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


def run(megabytes: int, profile: str | None) -> dict[str, float]:
    """Transfer; returns CPU seconds per side, fragments and payload bits."""
    nodes = {"a": make("a"), "b": make("b")}
    meters = {"a": Meter(profile == "sender"), "b": Meter(profile == "receiver")}
    now = 0.0

    def carry(source: str, sink: str) -> bool:
        """Pass one batch, as one system call does; False when there was none."""
        node = nodes[source]
        with meters[source]:
            timer = node.next_timer()
            if timer is not None and timer <= now:
                node.handle_timer(now)
            batch = node.datagrams_to_send(now)
        address = ADDRESSES[source]
        with meters[sink]:
            receive = nodes[sink].receive
            for datagram in batch:
                receive(datagram.data, "wire", address, now)
        return bool(batch)

    def exchange() -> None:
        """Pass batches in both directions until both sides are idle; each direction takes half a round trip."""
        nonlocal now
        busy = True
        while busy:
            busy = carry("a", "b")
            now += ROUND_TRIP_S / 2
            busy = carry("b", "a") or busy
            now += ROUND_TRIP_S / 2

    for _ in range(2000):
        exchange()
        now += ROUND_TRIP_S
    for meter in meters.values():
        meter.seconds = 0.0
    payload = bytes(MESSAGE_BYTES)
    messages = max(1, megabytes * 1_000_000 // MESSAGE_BYTES)
    delivered = received = sent = 0
    before = nodes["a"].conditions(now).counters
    started = now
    while delivered < messages:
        if sent - delivered < 2 and sent < messages:
            nodes["a"].send("bulk", payload, destination="b", now=now)
            sent += 1
        exchange()
        now += ROUND_TRIP_S / 2
        for name, kind in (("a", MessageDelivered), ("b", MessageReceived)):
            while (event := nodes[name].next_event()) is not None:
                if isinstance(event, kind):
                    if name == "a":
                        delivered += 1
                    else:
                        received += 1
        if now - started > 600:
            raise SystemExit("no progress: the transfer stalled")
    assert received == messages
    after = nodes["a"].conditions(now).counters
    for meter in meters.values():
        if meter.profile is not None:
            pstats.Stats(meter.profile).sort_stats("tottime").print_stats(22)
    return {
        "fragments": float(after.fragments_sent - before.fragments_sent),
        "retransmitted": float(after.fragments_retransmitted - before.fragments_retransmitted),
        "acknowledgements": float(nodes["b"].conditions(now).counters.acknowledgements_sent),
        "bits": 8.0 * messages * MESSAGE_BYTES,
        "sender_s": meters["a"].seconds,
        "receiver_s": meters["b"].seconds,
        "virtual_s": now - started,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--megabytes", type=int, default=200)
    parser.add_argument("--profile", choices=("sender", "receiver"))
    arguments = parser.parse_args()
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
