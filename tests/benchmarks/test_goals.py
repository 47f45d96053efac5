"""Evaluation of goals: every goal names an existing cell, and a missed goal is reported as missed."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.cells import OURS, SETS, cells
from benchmarks.goals import GOALS, compared, judged, medians
from benchmarks.page import fill
from benchmarks.tables import report
from benchmarks.trial import percentile


def test_every_goal_names_an_existing_cell_of_our_transport() -> None:
    known = {(cell.set, cell.name) for name in SETS for cell in cells(name) if cell.peer == OURS}
    assert {(goal.set, goal.cell) for goal in GOALS} <= known


def test_every_goal_is_printed_met_or_missed() -> None:
    results = [{"set": goal.set, "name": goal.cell, "peer": OURS, goal.figure: 1e12} for goal in GOALS]
    printed = report(results)
    assert printed.count("| met |") + printed.count("**missed**") == len(judged(results)) > 0


def test_cell_names_are_unique() -> None:
    names = [(cell.set, cell.peer, cell.name) for name in SETS for cell in cells(name)]
    assert len(names) == len(set(names))


@pytest.mark.parametrize(("share", "verdict"), [(0.96, True), (0.94, False), (None, False)])
def test_a_goal_is_met_only_if_its_threshold_is_reached(share: float | None, verdict: bool) -> None:
    results = [{"set": "loss", "name": "0%", "peer": OURS, "share": share}]
    verdicts = {goal.figure: met for goal, _, met in judged(results)}
    assert verdicts["share"] is verdict
    assert ("**missed**" in report(results)) is True


@given(st.lists(st.floats(0, 100), min_size=1), st.sampled_from([0.5, 0.9, 0.99, 1.0]))
def test_a_percentile_is_the_smallest_value_covering_its_share_of_samples(values: list[float], share: float) -> None:
    ordered = sorted(values)
    found = percentile(ordered, share)
    assert found is not None
    assert sum(value <= found for value in ordered) >= math.ceil(share * len(ordered))
    assert all(sum(value <= lower for value in ordered) < share * len(ordered) for lower in ordered if lower < found)


def test_a_cell_run_several_times_is_judged_by_its_median() -> None:
    runs = [{"set": "loss", "name": "0%", "peer": OURS, "share": share} for share in (0.2, 0.96, 0.97)]
    assert [(result["share"], result["runs"]) for result in medians(runs)] == [(0.96, 3)]
    assert [met for goal, _, met in judged(runs) if goal.figure == "share"] == [True]


def test_our_figures_are_compared_with_the_best_other_transport_and_marked_if_behind() -> None:
    cell = {"set": "loss", "name": "0%"}
    results = [
        {**cell, "peer": OURS, "share": 0.95, "urgent_p99_s": 0.02, "urgent_arrived": 1.0},
        {**cell, "peer": f"{OURS}, window 3", "share": 0.99, "urgent_p99_s": 0.001, "urgent_arrived": 1.0},
        {**cell, "peer": "fast", "share": 0.96, "urgent_p99_s": 0.2, "urgent_arrived": 1.0},
        {**cell, "peer": "lossy", "share": 0.1, "urgent_p99_s": 0.01, "urgent_arrived": 0.5},
    ]
    found = {one.figure: (one.best, one.best_peer, one.ahead) for one in compared(results)}
    assert found == {"share": (0.96, "fast", False), "urgent_p99_s": (0.2, "fast", True)}
    assert report(results).count("**behind**") == 1
    nothing: list[dict[str, object]] = [
        results[0],
        {**cell, "peer": "dead", "share": 0.0, "urgent_p99_s": None, "urgent_arrived": 0.0},
    ]
    assert [(one.figure, one.best, one.ahead) for one in compared(nothing)] == [
        ("share", 0.0, True),
        ("urgent_p99_s", None, True),
    ]


def test_a_figure_missing_from_most_runs_has_no_median() -> None:
    runs = [{"set": "cut", "name": "x", "peer": OURS, "recovery_any_s": value} for value in (0.1, None, None)]
    assert medians(runs)[0]["recovery_any_s"] is None


def test_filling_a_section_preserves_the_surrounding_page(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("before\n\n<!-- tables: how -->\n\nold\n\n<!-- end of tables -->\n\nafter\n")
    fill("tables", "new\\1", page)
    assert page.read_text() == "before\n\n<!-- tables: how -->\n\nnew\\1\n\n<!-- end of tables -->\n\nafter\n"
    with pytest.raises(ValueError, match="no such section"):
        fill("no such section", "new", page)
