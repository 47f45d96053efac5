"""Results -> for each figure and setting, the mean with its interval, and the paired difference to the first setting.

The runs of two settings with the same seed have the same randomness where the settings do not matter, so the
difference is taken seed by seed. Pure.
"""

from __future__ import annotations

import difflib
import operator
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Any

from mesh_sweep.cases import Settings, settings_order, settings_text
from mesh_sweep.errors import SweepError
from mesh_sweep.intervals import CONFIDENCE, Interval, mean_interval, share_interval
from mesh_sweep.results import Result

_GOAL = re.compile(r"\s*([^<>=\s]+)\s*(<=|>=)\s*(\S+)\s*")
_HOLDS: dict[str, Callable[[float, float], bool]] = {"<=": operator.le, ">=": operator.ge}


@dataclass(frozen=True, slots=True)
class Goal:
    """A bound on a figure; a run without the figure misses it."""

    figure: str
    sign: str
    bound: float

    def __str__(self) -> str:
        return f"{self.figure}{self.sign}{self.bound:g}"

    def is_met(self, result: Result) -> bool:
        value = result.figures.get(self.figure)
        return value is not None and _HOLDS[self.sign](value, self.bound)


@dataclass(frozen=True, slots=True)
class ComparedSetting:
    """One setting's runs: `count` of them have the figure. `difference` is None for the first setting."""

    settings: Settings
    runs: int
    count: int
    mean: Interval | None
    difference: Interval | None


@dataclass(frozen=True, slots=True)
class ComparedFigure:
    """A figure, or the share of the runs that meet a goal, for every setting."""

    name: str
    is_goal: bool
    rows: tuple[ComparedSetting, ...]


@dataclass(frozen=True, slots=True)
class Comparison:
    """All figures; `failed` are the cases without figures, with the reason."""

    figures: tuple[ComparedFigure, ...]
    runs: int
    failed: tuple[Result, ...]


def parse_goals(words: Iterable[str]) -> tuple[Goal, ...]:
    """The goals of `--goal FIGURE<=BOUND` options. Raises SweepError."""
    goals = []
    for word in words:
        match = _GOAL.fullmatch(word)
        try:
            bound = float(match[3]) if match else 0.0
        except ValueError:
            match = None
        if match is None:
            raise SweepError(f"--goal: expected FIGURE<=NUMBER or FIGURE>=NUMBER, found {word!r}")
        goals.append(Goal(match[1], match[2], bound))
    return tuple(goals)


def compare(results: Sequence[Result], patterns: Sequence[str], goals: Sequence[Goal] = ()) -> Comparison:
    """The comparison of the figures that match one of `patterns` (with `*`). Raises SweepError for a pattern that
    matches none."""
    good = [result for result in results if not result.failed]
    names = sorted({name for result in good for name in result.figures})
    _check_names([*patterns, *(goal.figure for goal in goals)], names)
    by_setting: dict[Settings, list[Result]] = {}
    for result in sorted(good, key=lambda result: (settings_order(result.case.settings), result.case.seed)):
        by_setting.setdefault(result.case.settings, []).append(result)
    chosen = [name for name in names if any(fnmatchcase(name, pattern) for pattern in patterns)]
    figures = [
        *(ComparedFigure(str(goal), True, _goal_rows(by_setting, goal)) for goal in goals),
        *(ComparedFigure(name, False, _rows(by_setting, name)) for name in chosen),
    ]
    return Comparison(tuple(figures), len(good), tuple(result for result in results if result.failed))


def check_figures(result: Result, patterns: Sequence[str], goals: Sequence[Goal]) -> None:
    """Raises SweepError for a figure or a goal that a result does not have."""
    _check_names([*patterns, *(goal.figure for goal in goals)], sorted(result.figures))


def _check_names(patterns: Sequence[str], names: Sequence[str]) -> None:
    for pattern in patterns if names else ():
        if not any(fnmatchcase(name, pattern) for name in names):
            near = difflib.get_close_matches(pattern, names, n=1, cutoff=0.4)
            meant = f"; did you mean {near[0]!r}?" if near else f"; they have {', '.join(names)}"
            raise SweepError(f"expected a figure of these results, found {pattern!r}{meant}")


def _rows(by_setting: dict[Settings, list[Result]], name: str) -> tuple[ComparedSetting, ...]:
    rows = []
    first: dict[int, float] | None = None
    for settings, runs in by_setting.items():
        values = {run.case.seed: value for run in runs if (value := run.figures.get(name)) is not None}
        mean = mean_interval(list(values.values())) if values else None
        difference = None
        if first is not None:
            pairs = [value - first[seed] for seed, value in values.items() if seed in first]
            difference = mean_interval(pairs) if pairs else None
        else:
            first = values
        rows.append(ComparedSetting(settings, len(runs), len(values), mean, difference))
    return tuple(rows)


def _goal_rows(by_setting: dict[Settings, list[Result]], goal: Goal) -> tuple[ComparedSetting, ...]:
    return tuple(
        ComparedSetting(
            settings, len(runs), len(runs), share_interval(sum(goal.is_met(run) for run in runs), len(runs)), None
        )
        for settings, runs in by_setting.items()
    )


def as_json(comparison: Comparison) -> dict[str, Any]:
    """The comparison as JSON values."""

    def interval(bounds: Interval | None) -> dict[str, float | None] | None:
        return None if bounds is None else {"estimate": bounds.estimate, "low": bounds.low, "high": bounds.high}

    return {
        "confidence": CONFIDENCE,
        "runs": comparison.runs,
        "failed": [
            {"set": dict(result.case.settings), "seed": result.case.seed, "reason": result.failed}
            for result in comparison.failed
        ],
        "figures": [
            {
                "name": figure.name,
                "kind": "share of runs" if figure.is_goal else "mean",
                "settings": [
                    {
                        "set": dict(row.settings),
                        "runs": row.runs,
                        "with_figure": row.count,
                        **({"share": interval(row.mean)} if figure.is_goal else
                           {"mean": interval(row.mean), "difference": interval(row.difference)}),
                    }
                    for row in figure.rows
                ],
            }
            for figure in comparison.figures
        ],
    }  # fmt: skip


def as_text(comparison: Comparison) -> str:
    """One table per figure."""
    lines: list[str] = []
    for figure in comparison.figures:
        lines += ["", f"{'runs with ' if figure.is_goal else ''}{figure.name}"]
        head = ("setting", "runs", "share" if figure.is_goal else "mean", "95 % interval")
        rows: list[tuple[str, ...]] = [head if figure.is_goal else (*head, "against the first, same seeds")]
        rows += [row_texts(figure, row) for row in figure.rows]
        widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
        lines += [
            "  " + "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
            for row in rows
        ]
    return "\n".join(lines[1:])


def row_texts(figure: ComparedFigure, row: ComparedSetting) -> tuple[str, ...]:
    """The cells of one row of the figure's table."""
    runs = str(row.runs) if row.count == row.runs else f"{row.count} of {row.runs}"
    cells = (settings_text(row.settings), runs, _estimate(row.mean, figure), _bounds(row.mean, figure))
    if figure.is_goal:
        return cells
    difference = row.difference
    if difference is None:
        return (*cells, "")
    bounds = "" if difference.low is None else f" ({difference.low:+.3g} to {difference.high:+.3g})"
    return (*cells, f"{difference.estimate:+.3g}{bounds}")


def _estimate(interval: Interval | None, figure: ComparedFigure) -> str:
    return "none" if interval is None else f"{interval.estimate:.1%}" if figure.is_goal else number(interval.estimate)


def _bounds(interval: Interval | None, figure: ComparedFigure) -> str:
    if interval is None or interval.low is None or interval.high is None:
        return "needs more runs"
    if figure.is_goal:
        return f"{interval.low:.1%} to {interval.high:.1%}"
    return f"{number(interval.low)} to {number(interval.high)}"


def number(value: float) -> str:
    """Four digits, without an exponent where people do not expect one."""
    return f"{value:.0f}" if 1e4 <= abs(value) < 1e12 else f"{value:.4g}"
