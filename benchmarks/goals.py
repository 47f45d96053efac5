"""The transport's goals (docs/facts/transport-facts.md, "Goals") as data, and their evaluation against the results.

A goal has a set, a cell, a figure and a bound; a missed goal is printed as missed. In addition, our result is compared
with the best other transport in every cell.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from statistics import median
from typing import Any

from benchmarks.cells import OURS


@dataclass(frozen=True, slots=True)
class Goal:
    """`at_least` or `at_most` bounds `figure` of our own result in `set`/`cell`."""

    set: str
    cell: str
    figure: str
    at_least: float | None = None
    at_most: float | None = None

    def is_met(self, value: float | None) -> bool:
        if value is None:
            return False
        return (self.at_least is None or value >= self.at_least) and (self.at_most is None or value <= self.at_most)


GOALS: tuple[Goal, ...] = (
    Goal("loss", "0%", "share", at_least=0.95),
    Goal("loss", "5%", "share", at_least=0.95),
    Goal("loss", "20%", "share", at_least=0.93),
    Goal("loss", "0%", "urgent_p99_s", at_most=0.020),
    Goal("loss", "5%", "urgent_p99_s", at_most=0.025),
    Goal("loss", "20%", "urgent_p99_s", at_most=0.050),
    Goal("loss", "20%", "wire_ratio", at_most=1.30),
    Goal("loss", "0%", "sender_cpu", at_most=0.05),
    Goal("loss", "0%", "receiver_cpu", at_most=0.05),
    Goal("bursts", "bursts of 10, 20 % in all, bulk alone", "share", at_least=0.93),
    Goal("round-trip", "2 ms, 0%", "share", at_least=0.95),
    Goal("round-trip", "100 ms, 0%", "share", at_least=0.90),
    Goal("round-trip", "100 ms, 20%", "share", at_least=0.90),
    Goal("round-trip", "2 ms, 0%", "urgent_p99_s", at_most=0.009),
    Goal("round-trip", "100 ms, 0%", "urgent_p99_s", at_most=0.058),
    Goal("rate", "1 Mbit/s, bulk alone", "share", at_least=0.95),
    Goal("rate", "20 Mbit/s, bulk alone", "share", at_least=0.95),
    Goal("cut", "5 s cut, 5 %", "recovery_fresh_s", at_most=0.2),
    Goal("change", "10 to 2 Mbit/s", "settled_p99_s", at_most=0.060),
    Goal("change", "20 to 60 ms", "share_after", at_least=0.88),
    Goal("gigabit", "1 Gbit/s, 2 ms", "goodput", at_least=900e6),
)


COMPARED: tuple[tuple[str, bool], ...] = (
    # figure, and whether more is better
    ("share", True),
    ("urgent_p99_s", False),
    ("recovery_fresh_s", False),
    ("share_after", True),
    ("settled_p99_s", False),
)
# below this, too few urgent messages arrive to compare latencies
_MIN_ARRIVED = 0.99


@dataclass(frozen=True, slots=True)
class Comparison:
    """Our figure in a cell and that of the best other transport; None where there is no comparable result."""

    set: str
    cell: str
    figure: str
    ours: float | None
    best: float | None
    best_peer: str
    more_is_better: bool

    @property
    def ahead(self) -> bool:
        if self.ours is None or self.best is None:
            return self.ours is not None
        return self.ours >= self.best if self.more_is_better else self.ours <= self.best


def medians(results: Iterable[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """One result per cell: the median of each figure over the runs that have it, and the number of `runs`.

    A figure that most runs lack (nothing arrived) is left out.
    """
    cells: dict[tuple[str, str, str], list[Mapping[str, Any]]] = {}
    for result in results:
        cells.setdefault((result["set"], result["name"], result["peer"]), []).append(result)
    summary = []
    for runs in cells.values():
        whole = dict(runs[0], runs=len(runs))
        for figure in {figure for run in runs for figure in run}:
            values = [run[figure] for run in runs if isinstance(run.get(figure), int | float)]
            if values:
                whole[figure] = median(values) if 2 * len(values) > len(runs) else None
        summary.append(whole)
    return summary


def compared(results: Iterable[Mapping[str, Any]]) -> list[Comparison]:
    """Our figures against the best other transport, in every cell that at least one of these completed."""
    cells: dict[tuple[str, str], dict[str, Mapping[str, Any]]] = {}
    for result in medians(results):
        cells.setdefault((result["set"], result["name"]), {})[result["peer"]] = result
    made = []
    for (set_name, name), peers in cells.items():
        others = {peer: result for peer, result in peers.items() if not peer.startswith(OURS)}
        if OURS not in peers or not others:
            continue
        for figure, more_is_better in COMPARED:
            if all(peer.get(figure) is None for peer in peers.values()):
                # not measured in this cell: a load without urgent messages, or without a cut
                continue
            known = {peer: value for peer, r in others.items() if (value := _comparable(r, figure)) is not None}
            best_peer = (max if more_is_better else min)(known, key=known.__getitem__) if known else ""
            ours = _comparable(peers[OURS], figure)
            made.append(Comparison(set_name, name, figure, ours, known.get(best_peer), best_peer, more_is_better))
    return made


def _comparable(result: Mapping[str, Any], figure: str) -> float | None:
    arrived = result.get("urgent_arrived")
    if figure == "urgent_p99_s" and arrived is not None and arrived < _MIN_ARRIVED:
        return None
    value = result.get(figure)
    return None if value is None else float(value)


def judged(results: Iterable[Mapping[str, Any]]) -> list[tuple[Goal, float | None, bool]]:
    """Every goal whose cell was run, with our figure (the median of the runs) and whether the goal is met."""
    ours = {(r["set"], r["name"]): r for r in medians(results) if r["peer"] == OURS}
    verdicts = []
    for goal in GOALS:
        result = ours.get((goal.set, goal.cell))
        if result is not None:
            value = result.get(goal.figure)
            verdicts.append((goal, value, goal.is_met(value)))
    return verdicts
