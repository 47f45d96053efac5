"""The text of a plan: totals, order with reasons, what is interrupted, masked diffs, refusals."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import replace

import pytest

from meshctl.plan import Cut, Effect, FileChange, NodePlan, Plan, Stage, StageKind, Verdict, fleet_plan
from meshctl.report.changed_options import settings
from meshctl.report.plan_text import plan_lines, question
from tests.meshctl.plan.support import PASS_PHRASE, fleet, graph, plans, running

LINE = graph("base-b01", "b01-b02")


def read(plan: Plan, *, with_diffs: bool = True, width: int | None = None, order: Iterable[str] = ()) -> str:
    return "\n".join(line.text for line in plan_lines(plan, with_diffs=with_diffs, width=width, order=order))


def another_host_name() -> Plan:
    seen = {name: running(fleet(), name) for name in ("base", "b01", "b02")}
    for name in ("b01", "b02"):
        old = seen[name].uci
        assert old is not None
        seen[name] = replace(seen[name], uci={**old, "wireless": old["wireless"].replace("'100'", "'200'")})
    return fleet_plan(fleet(), plans(fleet(), seen), LINE, now_s=0.0)


def test_the_text_starts_with_the_totals_and_gives_a_reason_per_stage() -> None:
    text = read(another_host_name())
    assert text.startswith("fleet team: 2 to change, 1 up to date\nreached through base\n")
    assert "  1  rolling b02\n             b02 is 2 hops away" in text
    assert "alone, because it is a cut vertex: while it is down b02 cannot be reached" in text


def test_the_text_shows_interruptions_and_masked_diffs() -> None:
    text = read(another_host_name())
    assert "2 nodes  each cuts its mesh links\n  b01, b02\n" in text
    assert "-\toption beacon_int '200'" in text
    assert PASS_PHRASE not in text
    brief = read(another_host_name(), with_diffs=False)
    assert "  changed   etc/config/wireless: beacon_int 200 -> 100\n" in brief
    assert "option" not in brief


def test_a_txpower_reduction_is_shown_as_cutting_only_weak_links() -> None:
    seen = {name: running(fleet(), name) for name in ("base", "b01", "b02")}
    old = seen["b01"].uci
    assert old is not None
    stronger = re.sub(r"(option txpower) '\d+'", r"\1 '30'", old["wireless"])
    assert stronger != old["wireless"]
    seen["b01"] = replace(seen["b01"], uci={**old, "wireless": stronger})
    text = read(fleet_plan(fleet(), plans(fleet(), seen), LINE, now_s=0.0))
    assert "b01  cuts weak mesh links, if any\n" in text
    assert "radio0: txpower set without a restart; cuts weak mesh links, if any" in text
    assert "b02 cannot be reached if a weak link breaks" in text
    assert "b01 is a cut vertex: b02 may be unreachable meanwhile" in text


def test_a_refusal_is_shown_last_with_its_remedy() -> None:
    new = fleet(channel=11)
    seen = {name: None if name == "b02" else running(fleet(), name) for name in ("base", "b01", "b02")}
    text = read(fleet_plan(new, plans(new, seen), LINE, now_s=0.0))
    assert "b02  away: did not answer" in text
    assert "refused: mesh main changes its cell and would leave behind b02, b03, b04, b05" in text
    assert text.endswith("acknowledge with --leave-behind b02,b03,b04,b05")


def test_the_prompt_counts_the_nodes_that_change_cell() -> None:
    assert question(another_host_name()) == "Change 2 nodes?"
    new = fleet(channel=11)
    everybody = plans(new, {name: running(fleet(), name) for name in new.nodes})
    assert question(fleet_plan(new, everybody, LINE, now_s=0.0)) == "Change 6 nodes (6 change cell together)?"


HEAD = "--- a/etc/config/wireless\n+++ b/etc/config/wireless\n@@ -1,9 +1,9 @@\n"
CHANNEL = FileChange(
    "etc/config/wireless",
    "changed",
    HEAD + " config wifi-device 'radio0'\n-\toption channel '149'\n+\toption channel '157'\n"
    "-\toption txpower '27'\n+\toption txpower '25'\n \toption htmode 'HT20'\n",
)


def large() -> Plan:
    """Fourteen alike, of which one is at another place of its file, one other, one refused, one away."""
    moved = replace(CHANNEL, diff=CHANNEL.diff.replace("@@ -1,9 +1,9 @@", "@@ -4,9 +4,9 @@").replace("HT20", "VHT80"))
    effects = (Effect("network", Cut.MESH, "wireless changes"),)
    names = [f"b{number:02}" for number in range(13)]
    nodes = {
        name: NodePlan(
            name, Verdict.CHANGE, files=(moved if name == "b07" else CHANNEL,), effects=effects, splits=("channel",)
        )
        for name in reversed(names)
    }
    nodes["odd"] = NodePlan("odd", Verdict.CHANGE, files=(FileChange("etc/banner", "added", HEAD + "+hi\n"),))
    nodes["uav1-radio"] = NodePlan("uav1-radio", Verdict.REFUSED, reason="no port eth0.1 (it has eth0)")
    nodes["gone"] = NodePlan("gone", Verdict.AWAY, reason="did not answer")
    stage = Stage(StageKind.SWITCH, (*names, "odd"), "mesh main changes its cell", mesh="main")
    return Plan("team", 0.0, ("b00",), nodes, stages=(stage,))


ORDER = (*(f"b{number:02}" for number in range(13)), "uav1-radio", "gone", "odd")


@pytest.mark.parametrize("with_diffs", [True, False])
def test_nodes_with_equal_changes_form_one_block_in_inventory_order(with_diffs: bool) -> None:
    text = read(large(), with_diffs=with_diffs, order=ORDER)
    assert "13 nodes  each cuts its mesh links\n  b00, b01, b02, b03," in text
    assert "  changed   etc/config/wireless: radio0: channel 149 -> 157, txpower 27 -> 25\n" in text
    assert text.count("etc/config/wireless: ") == 1
    assert text.index("13 nodes") < text.index("uav1-radio  refused") < text.index("odd  cuts")


def test_the_last_lines_repeat_the_totals_and_the_excluded_nodes() -> None:
    assert read(large(), order=ORDER).splitlines()[-3:] == [
        "14 to change, 1 away, 1 refused",
        "  refused: uav1-radio, no port eth0.1 (it has eth0)",
        "  away: gone, did not answer",
    ]


def test_nodes_refused_for_the_same_reason_form_one_block() -> None:
    refused = {name: NodePlan(name, Verdict.REFUSED, reason="it has no port eth9", hint="correct it") for name in ORDER}
    refused["odd"] = NodePlan("odd", Verdict.REFUSED, reason="wrong board")
    text = read(Plan("team", 0.0, ("b00",), refused), order=ORDER)
    assert "15 nodes  refused: it has no port eth9\n  b00, b01, b02," in text
    assert text.count("it has no port eth9") == 2
    assert (
        "  refused: 15 nodes (b00, b01, b02, b03 and 11 more): it has no port eth9\n  refused: odd, wrong board" in text
    )
    assert text.count("hint: correct it") == 1


def test_a_mesh_change_shows_each_members_reason() -> None:
    text = read(large(), order=ORDER)
    assert ", b11, b12: channel\n" in text
    assert "odd: changes with its mesh\n" in text


@pytest.mark.parametrize("width", [40, 60, 80, 120])
def test_only_diff_lines_may_be_wider_than_the_terminal(width: int) -> None:
    lines = list(plan_lines(large(), width=width, order=ORDER))
    assert max(len(line.text) for line in lines if not line.is_diff) <= width
    joined = " ".join(" ".join(line.text.split()) for line in lines)
    assert ", ".join(ORDER[:13]) in joined, "and nothing is lost"


def test_settings_are_named_with_their_section_and_both_values() -> None:
    diff = (
        " config interface 'lan'\n-\tlist ports 'eth0'\n-\tlist ports 'eth1'\n+\tlist ports 'eth0'\n"
        "+\toption mtu '1532'\n"
        "@@ -9,4 +9,2 @@\n-\toption proto 'none'\n+config device 'br'\n+\toption type 'bridge'\n"
    )
    assert settings(FileChange("etc/config/network", "changed", HEAD + diff)) == (
        "br: new section",
        "lan: ports eth0 eth1 -> eth0",
        "proto removed (was none)",
        "lan: mtu set to 1532",
    )
    # another order of options
    moved = (
        "@@ -1,3 +1,3 @@\n config wifi-device 'radio0'\n"
        "-\toption band '2g'\n-\toption channel '1'\n+\toption channel '6'\n+\toption band '2g'\n"
    )
    assert settings(FileChange("etc/config/wireless", "changed", HEAD + moved)) == ("radio0: channel 1 -> 6",)
    assert settings(FileChange("etc/x", "changed", "mode 0644 -> 0600\n")) == ("mode 0644 -> 0600",)
    assert settings(FileChange("etc/x", "added", HEAD + "+a\n")) == ()
    assert settings(FileChange("etc/x", "changed", HEAD + "-a\n+b\n")) == ("2 lines",)


def test_nodes_that_differ_only_in_the_digest_of_their_configuration_form_one_block() -> None:
    def record(node: str, digit: str) -> FileChange:
        head = "--- a/etc/meshctl/node\n+++ b/etc/meshctl/node\n@@ -1,3 +1,3 @@\n"
        return FileChange(
            "etc/meshctl/node",
            "changed",
            f"{head} fleet=team\n node={node}\n-config={digit * 64}\n+config={'f' * 64}\n",
        )

    nodes = {
        name: NodePlan(name, Verdict.CHANGE, files=(CHANNEL, record(name, digit)))
        for name, digit in (("b01", "1"), ("b02", "2"))
    }
    text = read(Plan("team", 0.0, ("b01",), nodes))
    assert "2 nodes  each cuts" in text
    assert text.count("option channel") == 2
    assert "  changed   etc/meshctl/node: digest of its configuration\n\n" in text
    renamed = record("b01", "1")
    renamed = replace(renamed, diff=renamed.diff.replace(" node=b01", "-node=spare1\n+node=b01"))
    assert "-node=spare1" in read(
        Plan("team", 0.0, ("b01",), {"b01": NodePlan("b01", Verdict.CHANGE, files=(renamed,))})
    )


def test_a_refused_change_of_a_large_mesh_names_its_absent_nodes_once() -> None:
    """75 names stood in the block of each reason, in the totals, in the refusal and in its hint."""
    names = [f"h{number:02}" for number in range(75)]
    plan = large()
    away = {
        name: NodePlan(name, Verdict.AWAY, reason=f"{name} (10.42.1.{number}): no answer; heard by b0{number % 9}")
        for number, name in enumerate(names)
    }
    text = read(replace(plan, nodes={**plan.nodes, **away}))
    assert all(text.count(f"{name}  away: 10.") == 1 for name in names)
    assert all(text.count(name) == 1 for name in names[4:])
    assert "  away: 75 nodes (h00, h01, h02, h03 and 71 more): no answer\n" in f"{text}\n"
