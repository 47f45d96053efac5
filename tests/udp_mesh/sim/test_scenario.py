"""Scenario files: the shipped ones load, anything wrong is told with its line, nothing raises another exception."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from udp_mesh.sim.command import SHIPPED, run_command, shipped
from udp_mesh.sim.scenario import ScenarioError, load, parse

GOOD = """\
seed: 3
duration_s: 5
robots:
  a: [0, 0]
  b: {path: [[0, 10, 0], [5, 20, 0]]}
topics:
  estop: {priority: 0}
flows:
  - {topic: estop, sources: [a], destination: b, period_s: 1, size_bytes: 20}
"""


@pytest.mark.parametrize("name", shipped())
def test_each_shipped_scenario_loads(name: str) -> None:
    assert load(SHIPPED / f"{name}.yaml").name == name


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("a: [0, 0]", "a: [0]", "s.yaml:4: robots.a: expected [x, y] in metres, found a list"),
        ("priority: 0", "priority: 99", "s.yaml:7: topics.estop: expected a topic that can be used"),
        ("priority: 0", "urgency: 0", "s.yaml:7: topics.estop: expected one of priority, reliable"),
        ("topic: estop,", "topic: stop,", "s.yaml:9: flows[0].topic: expected one of estop, found 'stop'"),
        ("destination: b", "destination: c", "s.yaml:9: flows[0].destination: expected one of a, b, found 'c'"),
        ("[5, 20, 0]", "[0, 20, 0]", "rising times"),
        ("seed: 3", "sed: 3", "s.yaml:1: scenario: expected one of name, seed"),
        ("duration_s: 5", "duration_s: soon", "s.yaml:2: duration_s: expected a number of at least 0, found 'soon'"),
    ],
)
def test_a_problem_is_told_with_its_line(old: str, new: str, message: str) -> None:
    with pytest.raises(ScenarioError) as raised:
        parse(GOOD.replace(old, new).encode(), "s.yaml")
    assert message in str(raised.value)


def test_all_problems_are_told_at_once() -> None:
    with pytest.raises(ScenarioError) as raised:
        parse(GOOD.replace("priority: 0", "priority: x").replace("[0, 0]", "{}").encode(), "s.yaml")
    assert len(str(raised.value).splitlines()) >= 2


@given(st.one_of(st.binary(), st.text(alphabet="abz:{}[]-,0 \n\t&*'\"").map(str.encode)))
def test_any_bytes_give_a_scenario_or_a_scenario_error(raw: bytes) -> None:
    try:
        parse(raw, "s.yaml")
    except ScenarioError as error:
        assert str(error).startswith("s.yaml")


def test_an_alias_is_refused() -> None:
    with pytest.raises(ScenarioError, match="no aliases"):
        parse(b"robots: &r {a: [0, 0]}\nrelays: *r\n", "s.yaml")


def test_a_missing_file_is_an_error_and_exit_code_2(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_command(["no-such-scenario"]) == 2
    assert "expected a file or one of" in capsys.readouterr().err
