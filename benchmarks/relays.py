"""Relays: urgent latency through a busy one, and how long traffic pauses when one dies.

    python -m benchmarks.relays [--seeds N]

`busy`: `a` sends an urgent message of 100 B every 50 ms to `d` behind relay `r`, whose slow network also carries two
bulk flows of 10 MB each; `idle` is the same without them. `death`: `a` and `d` are joined by relay `b`, and by `c` and
`e`; `a` sends 20 messages a second; `b` dies. The pause is the longest time between two arrivals at `d`, the switch the
time from the death to the first datagram's route over the other path. In virtual time: a seed gives the same figures
anywhere.
"""

from __future__ import annotations

import argparse
import statistics
from itertools import pairwise

from udp_mesh.core.events import MessageDelivered, MessageReceived, PeerRouteChanged
from udp_mesh.core.settings import RelaySettings, Settings, Topic
from udp_mesh.crypto import Key
from udp_mesh.sim.topology import Topology

KEYS = (Key(bytes(range(32))),)
EVERY = RelaySettings(all=True)
TOPICS = (Topic("stop", priority=0), Topic("bulk", priority=15))
RATES_BITS_PER_S = (1e6, 5e6, 20e6)
BULK_BYTES = 1_000_000


def settings(name: str, relay: RelaySettings | None = None) -> Settings:
    return Settings(name=name, keys=KEYS, topics=TOPICS, relay=relay or RelaySettings())


def busy(seed: int, rate_bits_per_s: float, *, bulk: bool, loss: float) -> list[float]:
    """Latencies of urgent messages through a relay, in seconds."""
    topology = Topology(seed)
    topology.network("fast", rate_bits_per_s=50e6, loss=loss)
    topology.network("slow", rate_bits_per_s=rate_bits_per_s, loss=loss)
    for name, relay, networks in (
        ("a", None, ["fast"]),
        ("b", None, ["fast"]),
        ("r", EVERY, ["fast", "slow"]),
        ("d", None, ["slow"]),
    ):
        topology.add(settings(name, relay), networks)
    topology.run(6)
    for name in ("b", "r") if bulk else ():
        for _ in range(10):
            topology.send(name, "bulk", bytes(BULK_BYTES), destination="d")
    topology.run(2)
    for _ in range(100):
        topology.send("a", "stop", bytes(100), destination="d")
        topology.run(0.05)
    topology.run(2)
    return [event.latency_s for _, event in topology.events["a"] if isinstance(event, MessageDelivered)]


def death(seed: int, loss: float) -> tuple[float, float, int]:
    """(switch, pause) in seconds, and messages of 400 that did not arrive."""
    topology = Topology(seed)
    for network in ("ab", "bd", "ac", "ce", "ed"):
        topology.network(network, loss=loss)
    topology.add(settings("a"), ["ab", "ac"])
    for name, networks in (("b", ["ab", "bd"]), ("c", ["ac", "ce"]), ("e", ["ce", "ed"])):
        topology.add(settings(name, EVERY), networks)
    topology.add(settings("d"), ["bd", "ed"])
    topology.run(8)
    died_at = 0.0
    for number in range(400):
        if number == 100:
            died_at = topology.now
            topology.stop("b")
        topology.send("a", "stop", bytes(100), destination="d")
        topology.run(0.05)
    topology.run(20)
    arrived = [at for at, event in topology.events["d"] if isinstance(event, MessageReceived)]
    changed = [at for at, event in topology.events["a"] if isinstance(event, PeerRouteChanged) and at > died_at]
    after = [at for at in arrived if at > died_at]
    pause_s = max((later - earlier for earlier, later in pairwise(arrived)), default=0.0)
    return (changed[0] - died_at if changed and after else float("inf")), pause_s, 400 - len(arrived)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=5)
    seeds = range(1, parser.parse_args().seeds + 1)
    print("| slow network | loss | relay | delivered | p50, ms | p99, ms |")
    print("| --- | --- | --- | --- | --- | --- |")
    for rate in RATES_BITS_PER_S:
        for loss in (0.0, 0.05):
            for bulk in (False, True):
                runs = [busy(seed, rate, bulk=bulk, loss=loss) for seed in seeds]
                latencies = sorted(latency for run in runs for latency in run)
                p99 = latencies[min(len(latencies) - 1, int(0.99 * len(latencies)))]
                print(
                    f"| {rate / 1e6:.0f} Mbit/s | {loss:.0%} | {'busy' if bulk else 'idle'} "
                    f"| {len(latencies)} of {100 * len(seeds)} "
                    f"| {1000 * statistics.median(latencies):.1f} | {1000 * p99:.1f} |",
                    flush=True,
                )
    print()
    print("| loss | switch, median (worst), s | pause, median (worst), s | lost |")
    print("| --- | --- | --- | --- |")
    for loss in (0.0, 0.05, 0.2):
        switches, pauses, lost = zip(*(death(seed, loss) for seed in seeds), strict=True)
        print(
            f"| {loss:.0%} | {statistics.median(switches):.2f} ({max(switches):.2f}) "
            f"| {statistics.median(pauses):.2f} ({max(pauses):.2f}) | {sum(lost)} of {400 * len(seeds)} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
