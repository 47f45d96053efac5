"""Settings compared: means, paired differences, shares of runs, and how they are printed."""

from __future__ import annotations

from html.parser import HTMLParser

import pytest

from mesh_sweep.cases import Case
from mesh_sweep.comparison import as_json, as_text, compare, parse_goals
from mesh_sweep.errors import SweepError
from mesh_sweep.page import page
from mesh_sweep.results import Identity, Result

LATENCY: dict[str, list[float | None]] = {"0": [1.0, 5.0, 9.0], "10": [1.1, 5.2, 9.0], "9": [2.0, 6.0, None]}
RESULTS = [
    *(
        Result(Case((("loss", loss),), seed), {"latency_s": value, "arrived": 1.0})
        for loss, values in LATENCY.items()
        for seed, value in enumerate(values, 1)
    ),
    Result(Case((("loss", "9"),), 4), failed="ZeroDivisionError: <x>"),
]


def test_differences_are_taken_seed_by_seed() -> None:
    (figure,) = compare(RESULTS, ["lat*"]).figures
    first, nine, ten = figure.rows
    assert [row.settings[0][1] for row in figure.rows] == ["0", "9", "10"]
    assert first.difference is None
    assert first.mean is not None
    assert first.mean.estimate == 5.0
    assert (nine.count, nine.runs) == (2, 3)
    assert nine.difference is not None
    # the same for both seeds, however different the seeds are
    assert (nine.difference.estimate, nine.difference.low, nine.difference.high) == (1.0, 1.0, 1.0)
    assert ten.difference is not None
    assert ten.difference.estimate == pytest.approx(0.1)


def test_a_run_without_the_figure_misses_its_goal() -> None:
    (figure,) = compare(RESULTS, [], parse_goals(["latency_s <= 5"])).figures
    shares = [row.mean.estimate for row in figure.rows if row.mean is not None]
    assert shares == [pytest.approx(2 / 3), pytest.approx(1 / 3), pytest.approx(1 / 3)]


def test_text_and_json_say_what_was_compared_and_what_failed() -> None:
    comparison = compare(RESULTS, ["latency_s"], parse_goals(["arrived>=1"]))
    text = as_text(comparison)
    assert "runs with arrived>=1" in text
    assert "loss=9   2 of 3  4     -21.41 to 29.41  +1 (+1 to +1)" in text
    found = as_json(comparison)
    assert found["failed"] == [{"set": {"loss": "9"}, "seed": 4, "reason": "ZeroDivisionError: <x>"}]
    assert found["figures"][1]["settings"][1]["difference"] == {"estimate": 1.0, "low": 1.0, "high": 1.0}
    assert found["figures"][0]["kind"] == "share of runs"


def test_an_unknown_figure_gets_a_suggestion() -> None:
    with pytest.raises(
        SweepError, match=r"expected a figure of these results, found 'latencys'; did you mean 'latency_s'"
    ):
        compare(RESULTS, ["latencys"])
    for wrong in ("latency_s<5", "latency_s<=x", "<=5"):
        with pytest.raises(SweepError, match="--goal: expected FIGURE<=NUMBER"):
            parse_goals([wrong])


def test_the_page_is_one_well_formed_file_that_loads_nothing() -> None:
    comparison = compare(RESULTS, ["*"], parse_goals(["arrived>=1"]))
    text = page(Identity("<mine>", "0" * 16, "1"), comparison)
    opened: list[str] = []
    attributes: list[str] = []

    class Check(HTMLParser):
        def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
            attributes.extend(name for name, _ in attrs)
            if tag not in ("meta", "circle", "path"):
                opened.append(tag)

        def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
            attributes.extend(name for name, _ in attrs)

        def handle_endtag(self, tag: str) -> None:
            assert opened.pop() == tag

    Check().feed(text)
    assert opened == []
    assert not {"src", "href"} & set(attributes)
    assert "&lt;mine&gt;" in text
    assert "ZeroDivisionError: &lt;x&gt;" in text
    assert text.count("<svg") == 3
