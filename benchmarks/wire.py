"""What a core on each side carries: the transports between two namespaces on a veth pair, with no emulator in between.

At a gigabit the emulator needs a core of its own, so that on a machine of two the cells of the comparison tell of the
machine. Here each end has one: bulk without end and urgent messages at 20 Hz, as there.

    python -m benchmarks.wire [--runs N] [--fill]
"""

from __future__ import annotations

import argparse
import sys
from statistics import median
from typing import Any

from benchmarks.cells import OURS, WARM_UP_S
from benchmarks.link.laboratory import Laboratory, Link, wire
from benchmarks.page import fill
from benchmarks.tables import row
from benchmarks.trial import Load, percentile, run

PEERS = (OURS, "QUIC (aioquic, cubic)", "Zenoh (TCP cubic)", "TCP cubic")
LOAD = Load(seconds=15.0, bulk_bytes=-1, urgent_hz=20.0)


def measure(lab: Laboratory, peer: str) -> dict[str, Any]:
    """Goodput in bit/s, times in seconds, processor time in cores."""
    seen = run(lab, peer, Link(), LOAD)
    start, end = seen.started_s + WARM_UP_S, seen.started_s + LOAD.seconds
    latencies = seen.latencies_s(start, end - 1.0)
    return {
        "goodput": seen.goodput(start, end),
        "p50": percentile(latencies, 0.5),
        "p99": percentile(latencies, 0.99),
        "sender": None if seen.sender_cpu_s is None else seen.sender_cpu_s / LOAD.seconds,
        "receiver": seen.receiver_cpu_s / LOAD.seconds,
    }


def table(results: dict[str, list[dict[str, Any]]]) -> str:
    lines = [
        row(["transport", "runs", "goodput, Mbit/s", "urgent p50, ms", "urgent p99, ms", "sender, cores",
             "receiver, cores"]),
        row(["---"] * 7),
    ]  # fmt: skip
    for peer, runs in results.items():
        figures = [("goodput", 1e-6, ".0f"), ("p50", 1e3, ".1f"), ("p99", 1e3, ".1f"), ("sender", 1, ".2f"),
                   ("receiver", 1, ".2f")]  # fmt: skip
        shown = []
        for figure, factor, form in figures:
            values = [run[figure] for run in runs if run[figure] is not None]
            shown.append(f"{median(values) * factor:{form}}" if values else "none")
        lines.append(row([peer, str(len(runs)), *shown]))
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.wire", description=__doc__)
    parser.add_argument("--runs", type=int, default=3, help="how often each is run; the table gives the median")
    parser.add_argument("--fill", action="store_true", help="put the table into docs/benchmarks.md")
    arguments = parser.parse_args()
    results: dict[str, list[dict[str, Any]]] = {peer: [] for peer in PEERS}
    with wire() as lab:
        for number in range(1, arguments.runs + 1):
            for peer in PEERS:
                print(f"[{number}/{arguments.runs}] {peer}", file=sys.stderr, flush=True)
                results[peer].append(measure(lab, peer))
    text = table(results)
    print(text)
    if arguments.fill:
        fill("wire", text)


if __name__ == "__main__":
    main()
