"""CPU time of the transport core on a 10 Mbit/s channel: `python -m benchmarks.own_work [--fill]`.

One robot's bulk and telemetry as in `one_channel`, in virtual time: no sockets and no waiting, so caches stay warm. CPU
time of processes on a link beyond this is the cost of system calls and of waking up for each datagram.
"""

from __future__ import annotations

import argparse
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from benchmarks.one_channel import COUNT_FROM_S, COUNT_S, OneChannel, channel
from benchmarks.page import fill
from benchmarks.tables import row
from udp_mesh.core.endpoint import Endpoint

ENTRIES = ("receive", "datagrams_to_send", "handle_timer", "next_timer", "next_event")
"""The methods of `Endpoint` that a driver calls for datagrams."""


@contextmanager
def timed() -> Iterator[dict[str, float]]:
    """CPU seconds in these methods, by the node's name."""
    spent_s: dict[str, float] = defaultdict(float)
    kept = {entry: getattr(Endpoint, entry) for entry in ENTRIES}

    def clocked(call: Any) -> Any:
        def entry(node: Endpoint, *arguments: Any, **options: Any) -> Any:
            started_s = time.process_time()
            try:
                return call(node, *arguments, **options)
            finally:
                spent_s[node.settings.name] += time.process_time() - started_s

        return entry

    try:
        for name, call in kept.items():
            setattr(Endpoint, name, clocked(call))
        yield spent_s
    finally:
        for name, call in kept.items():
            setattr(Endpoint, name, call)


def cores() -> tuple[float, float]:
    """CPU shares of sender and receiver."""
    world = OneChannel(1, channel=channel(), loss=0.0, seed=1)
    agenda = world.team.event_queue
    agenda.run_until(COUNT_FROM_S)
    with timed() as spent_s:
        agenda.run_until(COUNT_FROM_S + COUNT_S)
    return spent_s["robot1"] / COUNT_S, spent_s["base"] / COUNT_S


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.own_work", description=__doc__)
    parser.add_argument("--fill", action="store_true", help="write the table to docs/benchmarks.md")
    arguments = parser.parse_args()
    sender, receiver = cores()
    text = "\n".join([row(["", "cores"]), row(["---"] * 2), row(["sender", f"{sender:.3f}"]),
                      row(["receiver", f"{receiver:.3f}"])])  # fmt: skip
    print(text)
    if arguments.fill:
        fill("own work", text)


if __name__ == "__main__":
    main()
