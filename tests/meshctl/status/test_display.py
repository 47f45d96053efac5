"""The table fits the terminal and lists dropped columns; the JSON has every documented key."""

from __future__ import annotations

import ast
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import jsonschema  # type: ignore[import-untyped]
import pytest
from hypothesis import given
from hypothesis import strategies as st

from meshctl.errors import InputError
from meshctl.fleet.journal import LastKnown
from meshctl.model import Fleet
from meshctl.plan import FileChange, NodePlan, Verdict
from meshctl.status import FleetStatus, assess, preflight
from meshctl.status.alarm_codes import CODES
from meshctl.status.filters import select_devices
from meshctl.status.json_output import as_json, preflight_json
from meshctl.status.preflight import Check
from meshctl.status.rows import COLUMNS, TableCell
from meshctl.status.table import layout, table_lines
from meshctl.status.text import preflight_text, summary_lines, text, topic_lines
from meshctl.status.values import Alarm, Level, NoAnswer
from tests.meshctl.status.fleets import HEALTHY, NOW, TEAM, look_of, status_of

ROOT = Path(__file__).resolve().parents[3]
PAGE = (ROOT / "docs/status.md").read_text()


def broken(fleet: Fleet) -> FleetStatus:
    """Some of everything."""
    plan = NodePlan("b01", Verdict.CHANGE, files=(FileChange("etc/config/wireless", "changed", ""),))
    rover = replace(TEAM["rover"], peers=(), drift=("differs from the inventory: etc/udp-mesh.toml",))
    return status_of(
        fleet,
        {name: HEALTHY[name] for name in ("base", "b01")},
        {"rover": rover, "station": TEAM["station"]},
        plans={"b01": plan},
        known={
            "rover": LastKnown("rover", NOW - 600, {"version": "23.05.5", "hops": "2", "via": "b01", "heard": "b01"})
        },
        silent={"rover": NoAnswer("no answer to connect within 5 s")},
        silent_robots={"shelf": NoAnswer("no answer to connect within 5 s")},
    )


@pytest.mark.parametrize("width", [40, 50, 60, 72, 80, 100, 120, 200])
def test_no_line_is_wider_than_the_terminal(fleet: Fleet, width: int) -> None:
    status = broken(fleet)
    silent = [
        replace(topic, problem="nothing sent for 12 min, of all the topics there are")
        for topic in status.robots[0].topics
    ]
    status = replace(status, robots=(replace(status.robots[0], topics=tuple(silent)), *status.robots[1:]))
    lines = text(status, width, topics=True).splitlines()
    lines += preflight_text(preflight(fleet, status), width).splitlines()
    assert [line for line in lines if len(line) > width] == []


def test_a_preflight_ends_with_its_verdict_and_the_failed_checks(fleet: Fleet) -> None:
    output = preflight_text(preflight(fleet, broken(fleet)))
    assert output.splitlines()[-1].startswith("NO-GO: robot radios, beacons, configuration, ")
    assert preflight_text([Check("base", True, "answers")]).splitlines()[-1] == "GO"


def test_hidden_columns_are_listed(fleet: Fleet) -> None:
    output = " ".join(text(broken(fleet), 80).split())
    left_out = re.search(r"columns not shown: (.*?) \(use --wide", output)
    assert left_out is not None
    headings = text(broken(fleet), 80)
    for heading in left_out[1].split(", "):
        assert f"  {heading}  " not in headings.partition("name  ")[2].partition("\n")[0]
    assert "columns not shown" not in text(broken(fleet))


@given(
    st.lists(st.tuples(st.text("abc", min_size=1, max_size=12), st.text("xyz", max_size=20)), min_size=1, max_size=5),
    st.integers(20, 160),
)
def test_ranked_columns_are_dropped_to_fit_and_unranked_ones_are_kept(cells: list[tuple[str, str]], width: int) -> None:
    rows = [
        {column.key: TableCell(name if column.key == "name" else other or "-", "s") for column in COLUMNS}
        for name, other in cells
    ]
    shown = layout(rows, width)
    kept = {column.heading for column in shown.columns}
    assert kept.isdisjoint(shown.dropped)
    assert kept | set(shown.dropped) == {column.heading for column in COLUMNS}
    assert {column.heading for column in COLUMNS if not column.rank} <= kept
    for lines in (table_lines(rows, width), table_lines(rows)):
        assert len({len(line.split("  ")[0]) for line in lines[:1]}) == 1
    widest = max(len(line) for line in table_lines(rows, width)[: len(rows) + 1])
    if shown.dropped != tuple(column.heading for column in COLUMNS if column.rank):
        assert widest <= width


def test_an_empty_column_is_left_out_silently(fleet: Fleet) -> None:
    status = assess(look_of(fleet), fleet.managed(), NOW)
    assert "topics" not in text(status)
    assert "no room" not in text(status)


def test_the_summary_comes_first_and_is_repeated_after_a_long_table(fleet: Fleet) -> None:
    status = status_of(fleet)
    assert text(status).splitlines()[0].startswith("trio: all well")
    long = replace(status, nodes=status.nodes * 10)
    assert text(long).splitlines()[-1] == text(long).splitlines()[0]


def test_the_same_alarm_on_many_devices_is_one_line(fleet: Fleet) -> None:
    status = status_of(fleet, {}, {}, silent={name: NoAnswer("no answer") for name in fleet.nodes})
    many = replace(status, robots=(), nodes=tuple(node for node in status.nodes if node.alarms) * 3)
    lines = summary_lines(many)
    assert sum("unreachable on 9" in line for line in lines) == 1
    assert any("--alarm unreachable" in line for line in lines)


def test_brief_leaves_out_notes_and_advice(fleet: Fleet) -> None:
    output = text(broken(fleet), brief=True)
    assert "->" not in output
    assert "NOTE" not in output
    assert "ERROR" in output


def test_topics_are_shown_by_urgency(fleet: Fleet) -> None:
    lines = topic_lines(status_of(fleet))
    assert [line.split()[0] for line in lines] == ["topic", *["estop"] * 2, *["commands"] * 2, *["telemetry"] * 2]


def test_every_alarm_code_is_listed_and_documented() -> None:
    used = set()
    for path in (ROOT / "meshctl/status").glob("*.py"):
        for call in ast.walk(ast.parse(path.read_text())):
            if isinstance(call, ast.Call) and isinstance(call.func, ast.Name) and call.func.id in ("Alarm", "NoAnswer"):
                used |= {
                    arg.value for arg in call.args[1:2] if isinstance(arg, ast.Constant) and isinstance(arg.value, str)
                }
    assert used <= set(CODES)
    for code, meaning in CODES.items():
        assert f"| `{code}` | {meaning} |" in PAGE, f"docs/status.md: expected a row of {code}"


def test_every_column_is_documented() -> None:
    for column in COLUMNS:
        assert f"| `{column.heading}` |" in PAGE


def documented(value: Any) -> set[str]:
    """Every key of a JSON value."""
    if isinstance(value, dict):
        return set(value) | {key for inner in value.values() for key in documented(inner)}
    return {key for inner in value for key in documented(inner)} if isinstance(value, list) else set()


def test_every_field_of_the_json_is_documented(fleet: Fleet) -> None:
    output = as_json(broken(fleet))
    assert json.loads(json.dumps(output)) == output
    kept = {key for one in (*output["nodes"], *output["robots"]) for key in one["last_known"] or {}}
    fields = documented(output) | documented(preflight_json([Check("a", True, "b")]))
    missing = {field for field in fields - kept if f"`{field}`" not in PAGE}
    assert missing == set()


def test_the_json_conforms_to_its_schema(fleet: Fleet) -> None:
    schema = json.loads((ROOT / "docs/status.schema.json").read_text())
    jsonschema.Draft202012Validator.check_schema(schema)
    is_valid = jsonschema.Draft202012Validator(schema).validate
    unasked = status_of(fleet, robots={}, robots_skipped="--no-robots")
    statuses = (status_of(fleet), broken(fleet), status_of(fleet, {}, {}), unasked)
    for status in statuses:
        is_valid(as_json(status))
        is_valid(preflight_json(preflight(fleet, status)))
    with pytest.raises(jsonschema.ValidationError):
        is_valid({**as_json(statuses[0]), "an undocumented field": 1})


def test_unknown_facts_are_null_not_zero(fleet: Fleet) -> None:
    rover = next(node for node in as_json(broken(fleet))["nodes"] if node["name"] == "rover")
    assert rover["answers"] is False
    for fact in ("version", "drift", "uptime_s", "load", "memory_free", "channels", "neighbours", "hops", "quality"):
        assert rover[fact] is None, fact
    assert rover["last_known"]["hops"] == 2


def filtered(fleet: Fleet, words: list[str], alarms: list[str], **attributes: list[str]) -> list[str]:
    chosen = select_devices(fleet, words, Path.read_text, (), attributes, alarms)  # type: ignore[arg-type]
    return [one.name for one in chosen.apply(broken(fleet))]


@pytest.mark.parametrize(
    ("words", "options", "alarms", "shown"),
    [
        ([], {}, [], ["base", "station", "b01", "b02", "rover", "rover", "shelf", "shelf"]),
        (["b*"], {}, [], ["base", "b01", "b02"]),
        (["beacons", "!b02"], {}, [], ["b01"]),
        (["role:computer,!shelf"], {}, [], ["station", "rover"]),
        ([], {"group": ["beacons"]}, [], ["b01", "b02"]),
        ([], {"group": ["beacons"], "state": ["deployed"]}, [], ["b01"]),
        ([], {"robot": ["rover"]}, [], ["rover", "rover"]),
        ([], {"role": ["computer"]}, [], ["station", "rover", "shelf"]),
        ([], {"role": ["robot", "beacon"], "state": ["carried"]}, [], ["b02", "shelf"]),
        ([], {}, ["unreachable"], ["rover"]),
        ([], {}, ["any"], ["b01", "rover", "rover"]),
        ([], {"role": ["beacon"]}, ["drift"], ["b01"]),
    ],
)
def test_a_filter_shows_the_selected_devices(
    fleet: Fleet, words: list[str], options: dict[str, list[str]], alarms: list[str], shown: list[str]
) -> None:
    assert filtered(fleet, words, alarms, **options) == shown


@pytest.mark.parametrize(
    ("words", "options", "alarms", "hint"),
    [
        (["rovr"], {}, [], "did you mean 'rover'"),
        ([], {"group": ["beacon"]}, [], "did you mean 'beacons'"),
        ([], {"role": ["radio"]}, [], "base, beacon, robot, computer"),
        ([], {"state": ["lost"]}, [], "deployed, carried"),
        ([], {}, ["unreachble"], "did you mean 'unreachable'"),
    ],
)
def test_an_invalid_filter_is_rejected_with_a_hint(
    fleet: Fleet, words: list[str], options: dict[str, list[str]], alarms: list[str], hint: str
) -> None:
    with pytest.raises(InputError) as raised:
        filtered(fleet, words, alarms, **options)
    assert hint in raised.value.hint


def test_selected_robots_that_were_not_queried_are_mentioned(fleet: Fleet) -> None:
    """`status role:computer` of a lab said `all well` and `no device matches`."""
    unasked = status_of(fleet, robots={}, robots_skipped="--no-robots")
    kept = {
        word: [one.code for one in select_devices(fleet, [word], Path.read_text).apply(unasked).alarms]  # type: ignore[arg-type]
        for word in ("role:computer", "role:beacon")
    }
    assert kept == {"role:computer": ["robots-unasked"], "role:beacon": []}


def test_strangers_are_shown_without_a_selection_of_devices(fleet: Fleet) -> None:
    status = replace(status_of(fleet), strangers=("02:00:00:00:00:99",))
    kept = {
        " ".join((*words, *alarms)): select_devices(fleet, words, Path.read_text, alarms=alarms).apply(status).strangers  # type: ignore[arg-type]
        for words, alarms in (([], ["stranger"]), ([], ["any"]), ([], ["error"]), (["b01"], []), (["b01"], ["any"]))
    }
    assert [word for word, strangers in kept.items() if strangers] == ["stranger", "any"]


def test_alarms_of_many_sites_are_lines_of_their_own(fleet: Fleet) -> None:
    """Four of them were `site on 4: , , , `."""
    alarms = tuple(Alarm(Level.WARNING, "site", f"no contact with site {name}", "", (name,)) for name in "abcde")
    printed = text(replace(status_of(fleet), alarms=alarms), None)
    assert [line for line in printed.splitlines() if "no contact" in line] == [
        f"WARNING no contact with site {name}" for name in "abcde"
    ]


def test_the_alarms_that_exist_are_counted(fleet: Fleet) -> None:
    with pytest.raises(InputError) as raised:
        select_devices(fleet, (), Path.read_text, alarms=["nosuch"])  # type: ignore[arg-type]
    assert re.search(r"expected one of unreachable, .* and \d+ more", raised.value.hint)
