"""Scenario files: the shipped ones load, problems are reported with their line, nothing raises another exception."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from udp_mesh.sim.command import SHIPPED, run_command, shipped, text
from udp_mesh.sim.run import play
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
        ("a: [0, 0]", "a: [0]", "s.yaml:4: robots.a: expected [x, y] in meters, found a list"),
        ("priority: 0", "priority: 99", "s.yaml:7: topics.estop.priority: expected a number of at most 15, found '99'"),
        ("priority: 0", "priority: 1.5", "s.yaml:7: topics.estop.priority: expected an integer, found '1.5'"),
        ("priority: 0", "destinations: [c]", "s.yaml:7: topics.estop.destinations[0]: expected one of a, b, found 'c'"),
        ("  estop: {", "  e stop: {", "s.yaml:7: topics.e stop: expected a valid topic"),
        ("a: [0, 0]", "a: [0, .inf]", "s.yaml:4: robots.a[1]: expected a number of at least -1e+06, found '.inf'"),
        ("a: [0, 0]", "a: [0, inf]", "s.yaml:4: robots.a[1]: expected a number of at most 1e+06, found 'inf'"),
        ("a: [0, 0]", "a c: [0, 0]", "s.yaml:4: robots.a c: expected a valid node name, found"),
        ("a: [0, 0]", "a: [0, 0]\n  a: [0, 0]", "s.yaml:5: robots.a: expected each key once, found 'a'"),
        ("seed: 3", "relays: {a: [1, 1]}", "s.yaml:1: relays.a: expected a name that is not a robot's, found 'a'"),
        ("seed: 3", "seed: 1e400", "s.yaml:1: seed: expected a number of at most 1e+09, found '1e400'"),
        ("seed: 3", "window: 5000", "s.yaml:1: window: expected a number of at most 4096, found '5000'"),
        ("seed: 3", "channel: {rate: 0}", "s.yaml:1: channel.rate: expected a number of at least 1000, found '0'"),
        ("seed: 3", "channel: {queue_frames: 0}", "channel.queue_frames: expected a number of at least 1, found '0'"),
        ("seed: 3", "channel: {overhead_s: inf}", "channel.overhead_s: expected a number of at most 1, found 'inf'"),
        ("seed: 3", "air: {least_loss: 2}", "s.yaml:1: air.least_loss: expected a number of at most 1, found '2'"),
        ("seed: 3", "air: {good_m: 9, range_m: 5}", "s.yaml:1: air: expected range_m of at least good_m, 9, found 5.0"),
        ("seed: 3", "duration: 3", "thin (did you mean 'duration_s'?), found 'duration'"),
        ("seed: 3", "seed: [", "s.yaml:3: expected YAML, found a syntax error: "),
        (
            "seed: 3",
            "relays: {c: [1, 1]}\nincidents: [{at_s: 3, what: crash, who: c}]",
            "s.yaml:2: incidents[0].who: expected one of a, b, found 'c'",
        ),
        (
            "size_bytes: 20",
            "size_bytes: inf",
            "flows[0].size_bytes: expected a number of at most 4.1943e+06, found 'inf'",
        ),
        ("duration_s: 5", "duration_s: 0", "s.yaml:2: duration_s: expected a number of at least 0.001, found '0'"),
        ("priority: 0", "urgency: 0", "s.yaml:7: topics.estop: expected one of priority, reliable"),
        ("topic: estop,", "topic: stop,", "s.yaml:9: flows[0].topic: expected one of estop, found 'stop'"),
        ("destination: b", "destination: c", "s.yaml:9: flows[0].destination: expected one of a, b, found 'c'"),
        ("[5, 20, 0]", "[0, 20, 0]", "increasing times"),
        ("seed: 3", "sed: 3", "s.yaml:1: scenario: expected one of name, seed"),
        (
            "duration_s: 5",
            "duration_s: soon",
            "s.yaml:2: duration_s: expected a number of at least 0.001, found 'soon'",
        ),
    ],
)
def test_a_problem_is_reported_with_its_line(old: str, new: str, message: str) -> None:
    with pytest.raises(ScenarioError) as raised:
        parse(GOOD.replace(old, new).encode(), "s.yaml")
    assert message in str(raised.value)


def test_a_file_of_one_value_is_not_quoted_because_it_may_be_a_key() -> None:
    with pytest.raises(ScenarioError) as raised:
        parse(b"f772a084226a36ec", "fleet.key")
    assert str(raised.value).splitlines()[0] == "fleet.key:1: scenario: expected a mapping, found a single value"
    assert "f772" not in str(raised.value)


def test_all_problems_are_reported_at_once() -> None:
    with pytest.raises(ScenarioError) as raised:
        parse(GOOD.replace("priority: 0", "priority: x").replace("[0, 0]", "{}").encode(), "s.yaml")
    assert len(str(raised.value).splitlines()) >= 2


@given(st.one_of(st.binary(), st.text(alphabet="abz:{}[]-,0 \n\t&*'\"").map(str.encode)))
def test_any_bytes_give_a_scenario_or_a_scenario_error(raw: bytes) -> None:
    try:
        parse(raw, "s.yaml")
    except ScenarioError as error:
        assert str(error).startswith("s.yaml")


@pytest.mark.parametrize("words", [["--duration", "0"], ["--duration", "nan"], ["--duration", "inf"], ["--seed", "-1"]])
def test_an_invalid_duration_or_seed_is_a_usage_error(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        run_command(["final-run", *words])
    assert ended.value.code == 2
    assert f"argument {words[0]}: expected" in capsys.readouterr().err


def test_an_unwritable_directory_is_reported_before_the_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "taken").write_text("")
    assert run_command(["final-run", "--out", str(tmp_path / "taken")]) == 2
    assert capsys.readouterr().err == f"udp-mesh: {tmp_path}/taken: File exists\n"


KEYS = (
    "seed", "window", "channel.rate", "channel.overhead_s", "channel.queue_frames", "channel.attempts",
    "channel.broadcast_repeats", "channel.route_s", "channel.hop_delay_s", "air.good_m", "air.range_m",
    "air.least_loss",
)  # fmt: skip
VALUES = ("0", "-1", "1", "1.5", "1e400", "nan", "inf", ".inf", "-0.0", "1e18", "abc", "''", "true", "[]", "{}", "255")


@given(st.sampled_from(KEYS), st.sampled_from(VALUES))
def test_any_setting_value_is_simulated_or_reported(key: str, value: str) -> None:
    outer, _, inner = key.partition(".")
    changed = GOOD.replace("seed: 3", f"{outer}: {{{inner}: {value}}}" if inner else f"{outer}: {value}")
    try:
        scenario = parse(changed.replace("duration_s: 5", "duration_s: 0.2").encode(), "s.yaml")
    except ScenarioError as error:
        assert str(error).startswith("s.yaml:1: ")
    else:
        assert 0 <= play(scenario).summary()["channel"]["airtime_share"] < 50


def test_reasons_of_refused_messages_are_reported() -> None:
    summary = play(parse(GOOD.replace("a: [0, 0]", "a: [900, 0]").encode(), "s.yaml")).summary()
    assert summary["rejected_because"] == {"unknown peer": summary["rejected"]}
    assert summary["rejected"] > 0
    assert f"{summary['rejected']} refused ({summary['rejected']} unknown peer)" in text(summary)


def test_an_alias_is_refused() -> None:
    with pytest.raises(ScenarioError, match=r"^s.yaml:2: expected no aliases, found \*r$"):
        parse(b"robots: &r {a: [0, 0]}\nrelays: *r\n", "s.yaml")


def test_a_missing_file_is_an_error_and_exit_code_2(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_command(["no-such-scenario"]) == 2
    assert "expected a file or one of" in capsys.readouterr().err


def test_no_scenario_is_an_error_that_says_where_the_names_are(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_command([]) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err == "udp-mesh: expected a scenario, found none; `udp-mesh sim --list` lists the shipped ones\n"
