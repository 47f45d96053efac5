"""One trial: one transport over one link under one load.

`run` starts both ends in a laboratory, waits until they are connected, configures the link, runs the load, optionally
cuts or changes the link, and returns the measurements, which `benchmarks.goals` evaluates.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from benchmarks.link.laboratory import Count, Laboratory, Link, compiled
from benchmarks.peers import peer_called

READY_TIMEOUT_S = 60.0
# an end closes within this time, unless it hangs
END_TIMEOUT_S = 15.0
# the time for packets in flight to arrive after the sender stops
DRAIN_S = 4.0
_CONGESTION_CONTROL = Path(__file__).with_name("peers") / "congestion_control.c"


@dataclass(frozen=True, slots=True)
class Load:
    """`bulk_bytes` in total (0 none, -1 unlimited); the link is down for `cut_s` from `cut_after_s` on, or becomes
    `change` at `change_after_s`."""

    seconds: float
    bulk_bytes: int = 0
    urgent_hz: float = 0.0
    cut_after_s: float = 0.0
    cut_s: float = 0.0
    change_after_s: float = 0.0
    change: Link | None = None


@dataclass(frozen=True, slots=True)
class Measured:
    """Times are CLOCK_MONOTONIC seconds. `urgent` holds (number, sent, arrived), `bulk` (arrived, bytes so far)."""

    urgent: Sequence[tuple[int, float, float]]
    bulk: Sequence[tuple[float, int]]
    started_s: float
    first_bulk_sent_s: float | None
    link_changed_s: float | None
    sender_cpu_s: float | None
    receiver_cpu_s: float
    count: Count
    errors: Sequence[str]

    def goodput(self, since_s: float, until_s: float) -> float:
        """Delivered bulk in bit/s between two moments."""
        inside = [(at, total) for at, total in self.bulk if since_s <= at <= until_s]
        if len(inside) < 2:
            return 0.0
        return (inside[-1][1] - inside[0][1]) * 8 / (inside[-1][0] - inside[0][0])

    def latencies_s(self, since_s: float, until_s: float) -> list[float]:
        """Latencies of the urgent messages sent between two moments, sorted, without lost ones."""
        return sorted(arrived - sent for _, sent, arrived in self.urgent if since_s <= sent <= until_s)


def percentile(ordered: Sequence[float], share: float) -> float | None:
    """The smallest value that at least `share` of the ordered values do not exceed (nearest rank)."""
    return ordered[max(0, math.ceil(len(ordered) * share) - 1)] if ordered else None


def run(lab: Laboratory, peer: str, link: Link, load: Load) -> Measured:
    """Run the trial. Raises RuntimeError when an end does not get ready or writes no result."""
    lab.become(replace(link, loss=0.0, burst_enter=0.0, up=1))
    results = [lab.directory / "sent.json", lab.directory / "received.json"]
    for result in results:
        result.unlink(missing_ok=True)
    receive_s = load.seconds + DRAIN_S
    ends = [_start(lab, 1, peer, "receive", str(results[1]), str(receive_s), str(max(0, load.bulk_bytes)))]
    try:
        _ready(ends[0])
        words = [str(results[0]), str(load.seconds), str(load.bulk_bytes), str(load.urgent_hz)]
        ends.append(_start(lab, 0, peer, "send", lab.addresses[1], *words))
        _ready(ends[1])
        lab.become(link)
        lab.reset()
        went_s = time.monotonic()
        for end in ends:
            assert end.stdin is not None
            end.stdin.write(b"go\n")
            end.stdin.flush()
        changed_s = _while_it_runs(lab, load)
        # an end that hangs on a bad link is a result, too: the receiver has written what arrived
        with contextlib.suppress(subprocess.TimeoutExpired):
            ends[0].wait(receive_s + END_TIMEOUT_S)
        count = lab.count()
        if not (load.bulk_bytes > 0):
            with contextlib.suppress(subprocess.TimeoutExpired):
                ends[1].wait(END_TIMEOUT_S)
    finally:
        for end in ends:
            # a sender of a fixed amount is done once the receiver has everything
            _stop(end)
    return _read(results, count, went_s, changed_s)


def _while_it_runs(lab: Laboratory, load: Load) -> float | None:
    if load.cut_s:
        time.sleep(load.cut_after_s)
        lab.set(up=0)
        time.sleep(load.cut_s)
        lab.set(up=1)
        return time.monotonic()
    if load.change is not None:
        time.sleep(load.change_after_s)
        lab.become(load.change)
        return time.monotonic()
    return None


def _start(lab: Laboratory, host: int, peer: str, role: str, *words: str) -> subprocess.Popen[bytes]:
    """Start an end in its host, with the interpreter, the settings and the congestion control of the peer."""
    described = peer_called(peer)
    environ = {**os.environ, **described.environment}
    if described.congestion_control:
        library = compiled(_CONGESTION_CONTROL, lab.directory, "-shared", "-fPIC")
        environ |= {"LD_PRELOAD": str(library), "BENCHMARK_CONGESTION_CONTROL": described.congestion_control}
    python = str(described.python or sys.executable)
    command = [python, "-m", "benchmarks.peers.end", role, peer, *words]
    return subprocess.Popen(lab.inside(host, command), stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environ)


def _ready(end: subprocess.Popen[bytes]) -> None:
    assert end.stdout is not None
    if end.stdout.readline() != b"ready\n":
        raise RuntimeError(f"{end.args!r} exited with {end.wait()} before it was ready")


def _stop(end: subprocess.Popen[bytes]) -> None:
    end.terminate()
    try:
        end.wait(10)
    except subprocess.TimeoutExpired:
        end.kill()
        end.wait()
    for stream in (end.stdin, end.stdout):
        if stream is not None:
            stream.close()


def _read(results: Sequence[Path], count: Count, went_s: float, changed_s: float | None) -> Measured:
    received = _load(results[1])
    if received is None:
        raise RuntimeError("the receiver wrote no result")
    sent = _load(results[0]) or {"errors": ["the sender did not end"]}
    first = received["first_sent_s"][0] if received["first_sent_s"] else None
    return Measured(
        urgent=[tuple(each) for each in received["urgent"]],
        bulk=[tuple(each) for each in received["bulk"]],
        started_s=sent.get("started_s", went_s),
        first_bulk_sent_s=first,
        link_changed_s=changed_s,
        sender_cpu_s=sent.get("cpu_s"),
        receiver_cpu_s=received["cpu_s"],
        count=count,
        errors=sent.get("errors", []),
    )


def _load(path: Path) -> dict[str, Any] | None:
    if not path.exists():
        return None
    read: dict[str, Any] = json.loads(path.read_text())
    return read
