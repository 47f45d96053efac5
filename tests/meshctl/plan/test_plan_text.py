"""What a person reads of a plan: totals, order with reasons, what is cut, masked diffs, refusals."""

from __future__ import annotations

from dataclasses import replace

from meshctl.plan import Plan, fleet_plan
from meshctl.report.plan_text import plan_lines, question
from tests.meshctl.plan.support import PASS_PHRASE, fleet, graph, plans, running

LINE = graph("base-b01", "b01-b02")


def read(plan: Plan, *, with_diffs: bool = True) -> str:
    return "\n".join(line.text for line in plan_lines(plan, with_diffs=with_diffs))


def another_host_name() -> Plan:
    seen = {name: running(fleet(), name) for name in ("base", "b01", "b02")}
    for name in ("b01", "b02"):
        old = seen[name].uci
        assert old is not None
        seen[name] = replace(seen[name], uci={**old, "wireless": old["wireless"].replace("27", "20")})
    return fleet_plan(fleet(), plans(fleet(), seen), LINE, now_s=0.0)


def test_it_begins_with_the_totals_and_gives_every_stage_its_reason() -> None:
    text = read(another_host_name())
    assert text.startswith("fleet team: 2 to change, 1 as wanted\nreached through base\n")
    assert "  1  rolling b02\n             b02 is 2 hops away" in text
    assert "alone, a cut vertex: while it is down b02 cannot be reached" in text


def test_it_tells_what_is_cut_and_shows_masked_differences() -> None:
    text = read(another_host_name())
    assert "b01  cuts its mesh links" in text
    assert "-\toption txpower '20'" in text
    assert PASS_PHRASE not in text
    assert "txpower" not in read(another_host_name(), with_diffs=False)


def test_a_refusal_stands_at_its_end_with_its_remedy() -> None:
    new = fleet(channel=11)
    seen = {name: None if name == "b02" else running(fleet(), name) for name in ("base", "b01", "b02")}
    text = read(fleet_plan(new, plans(new, seen), LINE, now_s=0.0))
    assert "b02  away: did not answer" in text
    assert "refused: mesh main changes its cell, and would leave behind b02, b03, b04, b05" in text
    assert text.endswith("acknowledge with --leave-behind b02,b03,b04,b05")


def test_the_question_counts_what_is_dangerous() -> None:
    assert question(another_host_name()) == "Change 2 nodes?"
    new = fleet(channel=11)
    everybody = plans(new, {name: running(fleet(), name) for name in new.nodes})
    assert question(fleet_plan(new, everybody, LINE, now_s=0.0)) == "Change 6 nodes (6 change cell together)?"
