"""Settings in a scenario's text: what YAML reads afterwards has the value at the path, and nothing else changed."""

from __future__ import annotations

from typing import Any

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from mesh_sweep.errors import SweepError
from mesh_sweep.scenario_text import fingerprint, steps_of, with_settings

TEXT = """\
# a comment
seed: 3
air: {good_m: 70, range_m: 130}   # flow
channel:
  rate: 20e6
  attempts: 8
robots:
  a: [0, 0]
  b: {path: [[0, 10, 0], [5, 20, 0]]}
topics: {}
flows:
  - {topic: estop, period_s: 1}
  - topic: map
    period_s: 2
note: |
  two
  lines
last: "end"
"""
NAMED = frozenset({"robots", "topics"})


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("air.good_m", "5"),
        ("air.least_loss", "0.1"),
        ("channel.rate", "1e6"),
        ("channel.route_s", "2"),
        ("channel", "{rate: 5}"),
        ("robots.a", "[1, 2]"),
        ("robots.b.path[1][2]", "7"),
        ("flows[0].size_bytes", "9"),
        ("flows[1].period_s", "9"),
        ("flows[1].size_bytes", "9"),
        ("flows", "[]"),
        ("note", "one"),
        ("last", "'x'"),
        ("window", "5"),
        ("other.nested.key", "1"),
        ("seed", "{a: [1, {b: 2}]}"),
    ],
)
def test_only_the_value_at_the_path_changes(path: str, value: str) -> None:
    edited = with_settings(TEXT, ((path, value),), "s.yaml", NAMED)
    expected = yaml.safe_load(TEXT)
    _put(expected, steps_of(path), yaml.safe_load(value))
    assert yaml.safe_load(edited.text) == expected
    # all other lines keep their numbers, except below an added line
    lines = edited.text.splitlines()
    last = next(number for number, line in enumerate(lines, 1) if line.startswith("last:"))
    assert edited.original_line(last) == TEXT.splitlines().index('last: "end"') + 1


def _put(tree: Any, steps: list[str | int], value: Any) -> None:
    for step in steps[:-1]:
        tree = tree.setdefault(step, {}) if isinstance(tree, dict) else tree[step]
    tree[steps[-1]] = value


@pytest.mark.parametrize(
    ("path", "value", "problem"),
    [
        ("robots.c", "[0, 0]", "s.yaml:8: --set robots.c=[0, 0]: robots: expected one of a, b, found 'c'"),
        ("flows[2].x", "1", "s.yaml:12: --set flows[2].x=1: expected flows[0] to flows[1], found 2"),
        ("seed.x", "1", "s.yaml:2: --set seed.x=1: seed: expected a mapping or a list, found '3'"),
        ("a..b", "1", "--set a..b=1: expected a path such as air.range_m or flows[0].size_bytes, found 'a..b'"),
        ("seed", "1}", "--set seed=1}: expected one YAML value, found '1}'"),
        ("seed", "1], [2", "--set seed=1], [2: expected one YAML value, found '1], [2'"),
        ("seed", "&x 1", "--set seed=&x 1: expected one YAML value, found '&x 1'"),
        ("seed", "*x", "--set seed=*x: expected one YAML value, found '*x'"),
        ("seed", "a: b", "--set seed=a: b: expected one YAML value, found 'a: b'"),
        ("seed", "{}: {}", "--set seed={}: {}: expected one YAML value, found '{}: {}'"),
        ("seed", "{}:{}", "--set seed={}:{}: expected one YAML value, found '{}:{}'"),
        ("seed", "-", "--set seed=-: expected one YAML value, found '-'"),
        ("seed", "1 # x", "--set seed=1 # x: expected one YAML value, found '1 # x'"),
    ],
)
def test_what_does_not_fit_is_reported_with_file_and_line(path: str, value: str, problem: str) -> None:
    with pytest.raises(SweepError) as raised:
        with_settings(TEXT, ((path, value),), "s.yaml", NAMED)
    assert str(raised.value) == problem


def test_a_misspelled_name_gets_a_suggestion() -> None:
    text = "robots: {spot1: [0, 0], husky: [0, 0]}\n"
    with pytest.raises(SweepError, match=r"expected one of spot1, husky \(did you mean 'spot1'\?\), found 'spott1'"):
        with_settings(text, (("robots.spott1", "[1, 1]"),), "s.yaml", NAMED)


@given(st.text(alphabet="abz.[]01 {}:-,'\"#&*\n", max_size=12), st.text(alphabet="ab1,:[]{}'\"#&*!|> \n", max_size=12))
def test_any_path_and_value_give_yaml_or_a_sweep_error(path: str, value: str) -> None:
    try:
        edited = with_settings(TEXT, ((path, value),), "s.yaml", NAMED)
    except SweepError:
        return
    yaml.compose(edited.text, Loader=yaml.SafeLoader)


def test_the_fingerprint_is_that_of_the_content_in_its_order() -> None:
    one = fingerprint(["seed: 1\na: 1\nb: [1, 2]\n"])
    assert one == fingerprint(["# other layout\na: '1'\nb:\n  - 1\n  - 2\n"])
    assert len(one) == 16
    assert len({one, fingerprint(["b: [1, 2]\na: 1"]), fingerprint(["a: 1\nb: [1, 3]"]), fingerprint(["a: 1"])}) == 4
