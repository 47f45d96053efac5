"""Throughput with one core per side: the transports between two namespaces on a veth pair, without the emulator.

At a gigabit the emulator needs a core of its own, so on a machine with two cores the cells of the comparison measure
the machine. Here each end has a core: continuous bulk and urgent messages at 20 Hz, as there.

    python -m benchmarks.wire [--runs N] [--fill]
"""

from __future__ import annotations

import argparse
import sys
from typing import Any

from benchmarks.cells import OURS, Cell, measure
from benchmarks.link.laboratory import Link, wire
from benchmarks.page import fill
from benchmarks.tables import table
from benchmarks.trial import Load

PEERS = (OURS, "QUIC (aioquic, cubic)", "Zenoh (TCP cubic)", "TCP cubic")
LOAD = Load(seconds=15.0, bulk_bytes=-1, urgent_hz=20.0)


FIGURES = ("set", "name", "peer", "goodput", "urgent_p50_s", "urgent_p99_s", "sender_cpu", "receiver_cpu")


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.wire", description=__doc__)
    parser.add_argument("--runs", type=int, default=3, help="number of runs of each; the table shows the median")
    parser.add_argument("--fill", action="store_true", help="write the table to docs/benchmarks.md")
    arguments = parser.parse_args()
    results: list[dict[str, Any]] = []
    with wire() as lab:
        for number in range(1, arguments.runs + 1):
            for peer in PEERS:
                print(f"[{number}/{arguments.runs}] {peer}", file=sys.stderr, flush=True)
                figures = measure(lab, Cell("wire", peer, "veth", Link(), LOAD))
                # this link has no counters and no rate
                results.append({figure: figures[figure] for figure in FIGURES})
    text = table(results)
    print(text)
    if arguments.fill:
        fill("wire", text)


if __name__ == "__main__":
    main()
