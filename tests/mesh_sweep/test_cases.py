"""`--set` and `--seeds` as cases."""

from __future__ import annotations

import pytest

from mesh_sweep.cases import Case, cases_of, combinations, order, parse_parameters, parse_seeds
from mesh_sweep.errors import SweepError


def test_every_combination_runs_with_every_seed_seed_by_seed() -> None:
    settings = combinations(parse_parameters(["b=1,2", "a=x"], {}))
    assert settings == [(("a", "x"), ("b", "1")), (("a", "x"), ("b", "2"))]
    cases = cases_of(settings, range(1, 3))
    assert [(case.settings[1][1], case.seed) for case in cases] == [("1", 1), ("2", 1), ("1", 2), ("2", 2)]
    assert str(cases[0]) == "a=x b=1, seed 1"
    assert cases_of(combinations(()), range(1, 2)) == [Case((), 1)]


def test_commas_inside_brackets_and_quotes_belong_to_the_value() -> None:
    (found,) = parse_parameters(['robots.base=[0, 0],[10,0],"a,b",{x: 1, y: 2}'], {})
    assert found.values == ("[0, 0]", "[10,0]", '"a,b"', "{x: 1, y: 2}")


def test_a_short_name_stands_for_its_path() -> None:
    assert parse_parameters(["loss=0"], {"loss": "air.least_loss"})[0].path == "air.least_loss"


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        (["loss"], "--set loss: expected PATH=VALUE[,VALUE...], found no ="),
        (["=1"], "--set =1: expected PATH=VALUE[,VALUE...], found no path"),
        (["a=1,"], "--set a=1,: expected a value before and after each comma, found nothing"),
        (["a=1,1"], "--set a=1,1: expected each value once, found '1' twice"),
        (["seed=1"], "--set seed=1: expected no seeds here; use --seeds"),
        (["a=1", "a=2"], "--set a=2: expected each path once, found a in two options"),
        (["los=0"], "--set los=0: expected a path or a short name, found 'los'; did you mean 'loss'?"),
    ],
)
def test_a_wrong_parameter_is_reported(words: list[str], problem: str) -> None:
    with pytest.raises(SweepError) as raised:
        parse_parameters(words, {"loss": "air.least_loss"})
    assert str(raised.value) == problem


def test_seeds_are_a_number_or_a_range() -> None:
    assert parse_seeds("1000") == range(1, 1001)
    assert parse_seeds("501-1000") == range(501, 1001)
    for wrong in ("0", "", "x", "5-3", "-1", "1e3", "٣", "99999999999"):
        with pytest.raises(SweepError, match="--seeds: expected a number"):
            parse_seeds(wrong)


def test_too_many_cases_are_a_mistake() -> None:
    words = [f"p{number}={','.join(map(str, range(50)))}" for number in range(4)]
    with pytest.raises(SweepError, match="expected at most 1000000 cases, found 6250000"):
        combinations(parse_parameters(words, {}))
    with pytest.raises(SweepError, match="found 2000000"):
        cases_of([(), ()], range(1, 1_000_001))


def test_results_are_ordered_by_value_and_seed() -> None:
    values = ["10", "9", "abc", "0.5", "nan"]
    cases = [Case((("a", value),), seed) for value in values for seed in (2, 1)]
    ordered = sorted(cases, key=order)
    assert [case.settings[0][1] for case in ordered[::2]] == ["0.5", "9", "10", "abc", "nan"]
    assert [case.seed for case in ordered[:2]] == [1, 2]
