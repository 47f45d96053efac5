"""Results as Markdown: one table per set, then every goal with our figure, met or missed.

A cell with several runs is one row with the median of each figure.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from benchmarks.goals import compared, judged, medians

_COLUMNS: dict[str, tuple[str, float, str]] = {
    # figure: heading, factor, format
    "goodput": ("goodput, Mbit/s", 1e-6, ".2f"),
    "share": ("of rate x (1 - loss)", 1, ".3f"),
    "urgent_p50_s": ("urgent p50, ms", 1e3, ".0f"),
    "urgent_p99_s": ("urgent p99, ms", 1e3, ".0f"),
    "urgent_arrived": ("urgent arrived", 100, ".0f %"),
    "wire_ratio": ("wire bytes per byte", 1, ".3f"),
    "datagrams_per_mb": ("datagrams per MB", 1, ".0f"),
    "sender_cpu": ("sender, cores", 1, ".3f"),
    "receiver_cpu": ("receiver, cores", 1, ".3f"),
    "recovery_fresh_s": ("first fresh urgent after the cut, s", 1, ".2f"),
    "recovery_any_s": ("first urgent of any age, s", 1, ".2f"),
    "goodput_after": ("goodput in the next 8 s, Mbit/s", 1e-6, ".2f"),
    "share_after": ("of the link in the next 8 s", 1, ".3f"),
    "settled_p50_s": ("settled urgent p50, ms", 1e3, ".0f"),
    "settled_p99_s": ("settled urgent p99, ms", 1e3, ".0f"),
}


def row(cells: Iterable[str]) -> str:
    return f"| {' | '.join(cells)} |"


def verdict(met: bool) -> str:
    return "met" if met else "**missed**"


def shown(figure: str, value: float | None, *, more_digits: int = 0) -> str:
    if value is None:
        return "none"
    _, factor, form = _COLUMNS[figure]
    form, _, suffix = form.partition(" ")
    digits = int(form.strip(".f")) + more_digits
    return f"{value * factor:.{digits}f}" + (f" {suffix}" if suffix else "")


def table(results: Sequence[Mapping[str, Any]]) -> str:
    """One set's results, in the order they were run."""
    figures = [figure for figure in _COLUMNS if any(figure in result for result in results)]
    lines = [
        row(["link", "transport", "runs", *(_COLUMNS[figure][0] for figure in figures)]),
        row(["---"] * (3 + len(figures))),
    ]
    lines += [
        row(
            [result["name"], result["peer"], str(result["runs"])]
            + [shown(figure, result.get(figure)) for figure in figures]
        )
        for result in medians(results)
    ]
    return "\n".join(lines)


def report(results: Sequence[Mapping[str, Any]]) -> str:
    """All results as one Markdown text."""
    sets = list(dict.fromkeys(result["set"] for result in results))
    parts = [f"### {name}\n\n{table([r for r in results if r['set'] == name])}" for name in sets]
    goals = [row(["set", "link", "figure", "goal", "measured", ""]), row(["---"] * 6)]
    for goal, value, met in judged(results):
        heading, factor, _ = _COLUMNS[goal.figure]
        bound = goal.at_least if goal.at_least is not None else goal.at_most
        assert bound is not None
        sign = ">=" if goal.at_least is not None else "<="
        # one digit more than the bound has, or a goal missed by little would look met
        measured = shown(goal.figure, value, more_digits=1)
        goals.append(row([goal.set, goal.cell, heading, f"{sign} {bound * factor:g}", measured, verdict(met)]))
    parts += ["### goals\n\n" + "\n".join(goals), "### beside the best of the others\n\n" + _comparisons(results)]
    return "\n\n".join(parts) + "\n"


def _comparisons(results: Sequence[Mapping[str, Any]]) -> str:
    lines = [row(["set", "link", "figure", "ours", "best other", "which", ""]), row(["---"] * 7)]
    lines += [
        row(
            [
                result.set,
                result.cell,
                _COLUMNS[result.figure][0],
                shown(result.figure, result.ours),
                shown(result.figure, result.best),
                result.best_peer or "none",
                "ahead" if result.ahead else "**behind**",
            ]
        )
        for result in compared(results)
    ]
    return "\n".join(lines)
