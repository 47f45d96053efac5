"""The cells of the comparison: transport, link, load, and the figures of the result.

A set is one experiment; `cells()` lists its cells in the order they run; `measure` runs one and returns the figures
that `benchmarks.tables` prints and `benchmarks.goals` evaluates.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from itertools import chain
from typing import Any

from benchmarks.link.laboratory import Laboratory, Link
from benchmarks.peers import PEERS
from benchmarks.trial import Load, Measured, percentile, run

OURS = "udp_mesh"
BASE = Link(rate=10e6, delay_ms=10.0, queue=100)
# continuous bulk and telemetry at 20 Hz together; the first seconds are for finding the rate
SATURATED = Load(seconds=20.0, bulk_bytes=-1, urgent_hz=20.0)
BULK_ALONE = replace(SATURATED, urgent_hz=0.0)
WARM_UP_S = 5.0
CUT = Load(seconds=24.0, bulk_bytes=-1, urgent_hz=20.0, cut_after_s=7.0, cut_s=5.0)
# a radio that transmits a frame up to eight times on a half-duplex channel with 30 % loss, 100 us per frame
RADIO = Link(rate=20e6, delay_ms=1.0, loss=0.3, attempts=8, half=1, overhead_us=100.0, queue=200)
_CHANGED = {
    "10 to 2 Mbit/s": replace(BASE, rate=2e6, loss=0.02),
    "20 to 60 ms": replace(BASE, delay_ms=30.0, loss=0.02),
}
_RATES = {f"{rate / 1e6:.0f} Mbit/s": replace(BASE, rate=rate, loss=0.05) for rate in (1e6, 20e6)}
_BURSTS = {"bursts of 10, 20 % in all": replace(BASE, burst_enter=0.025, burst_leave=0.1)}
_SETTLE_S = 4.0
_AFTER_CHANGE_S = 8.0


@dataclass(frozen=True, slots=True)
class Cell:
    """`name` is unique within the set; both are the permanent key of the result."""

    set: str
    peer: str
    name: str
    link: Link
    load: Load


def _compared(set_name: str, names_and_links: dict[str, Link], load: Load, peers: list[str]) -> Iterator[Cell]:
    for name, link in names_and_links.items():
        for peer in peers:
            yield Cell(set_name, peer, name, link, load)


def cells(set_name: str) -> list[Cell]:
    """The cells of a set; raises KeyError for an unknown set."""
    peers = list(PEERS)
    rivals = [OURS, "TCP cubic", "TCP BBR", "QUIC (aioquic, cubic)", "Zenoh (TCP cubic)", "Zenoh (TCP BBR)"]
    # with the transports of ROS 2 and ROS 1, of which some have a fixed rate, set to that of the base link
    all_rivals = [name for name in peers if name != "udp_mesh, window 3"]
    makers: dict[str, Iterator[Cell]] = {
        "loss": _compared(
            "loss", {f"{share:.0%}": replace(BASE, loss=share) for share in (0, 0.01, 0.05, 0.1, 0.2)}, SATURATED, peers
        ),
        "round-trip": _compared(
            "round-trip",
            {
                f"{2 * delay_ms:.0f} ms, {share:.0%}": replace(BASE, delay_ms=delay_ms, loss=share)
                for delay_ms in (1.0, 50.0)
                for share in (0, 0.2)
            },
            SATURATED,
            rivals,
        ),
        # at 1 Mbit/s the urgent messages alone are 5 % of the link: goodput is measured without them
        "rate": chain(
            _compared("rate", {f"{name}, bulk alone": link for name, link in _RATES.items()}, BULK_ALONE, rivals),
            _compared("rate", _RATES, SATURATED, rivals),
        ),
        "bursts": chain(
            _compared("bursts", {f"{name}, bulk alone": link for name, link in _BURSTS.items()}, BULK_ALONE, rivals),
            _compared("bursts", _BURSTS, SATURATED, all_rivals),
        ),
        "cut": _compared("cut", {"5 s cut, 5 %": replace(BASE, loss=0.05)}, CUT, all_rivals),
        "change": iter(
            Cell("change", peer, name, replace(BASE, loss=0.02),
                 replace(SATURATED, seconds=22.0, change_after_s=8.0, change=after))
            for name, after in _CHANGED.items()
            for peer in all_rivals
        ),
        "radio": _compared("radio", {"half duplex, radio's own retries": RADIO}, SATURATED, rivals),
        "in-flight": iter(
            Cell("in-flight", f"udp_mesh, window {window}", f"{window}", BASE, SATURATED)
            for window in (1, 2, 3, 4, 8, 16, 32, 64)
        ),
        "gigabit": _compared(
            "gigabit", {"1 Gbit/s, 2 ms": Link(rate=1e9, delay_ms=1.0, queue=2000)},
            replace(SATURATED, seconds=12.0), rivals,
        ),
    }  # fmt: skip
    return list(makers[set_name])


SETS = ("loss", "cut", "change", "bursts", "round-trip", "rate", "radio", "in-flight", "gigabit")
QUICK = {"loss": ("0%", "20%"), "cut": ("5 s cut, 5 %",)}


def measure(lab: Laboratory, cell: Cell) -> dict[str, Any]:
    """Run one cell. Rates in bit/s, times in seconds, `share` of rate x (1 - loss), `wire_ratio` IP bytes per byte."""
    seen = run(lab, cell.peer, cell.link, cell.load)
    start, end = seen.started_s, seen.started_s + cell.load.seconds
    if cell.load.change is not None and seen.link_changed_s is not None:
        figures = _changed(cell, seen, seen.link_changed_s, end)
    elif seen.link_changed_s is not None:
        figures = _cut(seen, seen.link_changed_s)
    else:
        figures = _steady(cell, seen, start + WARM_UP_S, end)
    return {
        "set": cell.set, "peer": cell.peer, "name": cell.name, "link": asdict(cell.link), **figures,
        "errors": list(seen.errors),
    }  # fmt: skip


def _lost_share(link: Link) -> float:
    bursts = link.burst_enter / (link.burst_enter + link.burst_leave) * link.burst_loss if link.burst_enter else 0.0
    return (link.loss if link.attempts == 1 else 0.0) + bursts


def _steady(cell: Cell, seen: Measured, since_s: float, until_s: float) -> dict[str, Any]:
    latencies = seen.latencies_s(since_s, until_s - 1.0)
    urgent = (until_s - 1.0 - since_s) * cell.load.urgent_hz
    goodput = seen.goodput(since_s, until_s)
    delivered = seen.bulk[-1][1] if seen.bulk else 0
    sender, receiver = seen.count.ports[:2]
    return {
        "goodput": goodput,
        "share": goodput / (cell.link.rate * (1 - _lost_share(cell.link))),
        "urgent_p50_s": percentile(latencies, 0.5),
        "urgent_p99_s": percentile(latencies, 0.99),
        "urgent_arrived": len(latencies) / urgent if urgent else None,
        "wire_ratio": (sender.in_bytes + receiver.in_bytes) / delivered if delivered else None,
        "datagrams_per_mb": (sender.in_frames + receiver.in_frames) / delivered * 1e6 if delivered else None,
        "airtime_s_per_mb": seen.count.airtime_s / delivered * 1e6 if delivered else None,
        "sender_cpu": None if seen.sender_cpu_s is None else seen.sender_cpu_s / cell.load.seconds,
        "receiver_cpu": seen.receiver_cpu_s / cell.load.seconds,
        "cpu_s_per_mb": (seen.sender_cpu_s + seen.receiver_cpu_s) / delivered * 1e6
        if delivered and seen.sender_cpu_s is not None
        else None,
    }


def _cut(seen: Measured, back_s: float) -> dict[str, Any]:
    fresh = [arrived - back_s for _, sent, arrived in seen.urgent if sent > back_s]
    arrived = [at - back_s for _, _, at in seen.urgent if at > back_s]
    return {"recovery_fresh_s": min(fresh, default=None), "recovery_any_s": min(arrived, default=None)}


def _changed(cell: Cell, seen: Measured, changed_s: float, end_s: float) -> dict[str, Any]:
    assert cell.load.change is not None
    settled = seen.latencies_s(changed_s + _SETTLE_S, end_s - 1.0)
    after = cell.load.change
    return {
        "goodput_after": seen.goodput(changed_s, changed_s + _AFTER_CHANGE_S),
        "share_after": seen.goodput(changed_s, changed_s + _AFTER_CHANGE_S) / (after.rate * (1 - after.loss)),
        "settled_p50_s": percentile(settled, 0.5),
        "settled_p99_s": percentile(settled, 0.99),
    }
