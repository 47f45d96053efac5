"""What the transport is held to (docs/facts/transport-facts.md, "Goals"), as data the tables are checked against.

A goal names a set, a cell, a figure and a bound; a missed goal is printed as missed, never hidden.
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


def medians(results: Iterable[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """One result per cell: the median of each figure over the runs that have it, and how many `runs` there were.

    A figure that is missing in most runs (nothing arrived) is missing.
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


def judged(results: Iterable[Mapping[str, Any]]) -> list[tuple[Goal, float | None, bool]]:
    """Every goal whose cell was run, with our figure (the median of its runs) and whether it is met."""
    ours = {(r["set"], r["name"]): r for r in medians(results) if r["peer"] == OURS}
    verdicts = []
    for goal in GOALS:
        result = ours.get((goal.set, goal.cell))
        if result is not None:
            value = result.get(goal.figure)
            verdicts.append((goal, value, goal.is_met(value)))
    return verdicts
