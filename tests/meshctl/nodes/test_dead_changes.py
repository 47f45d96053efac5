"""What a killed meshctl leaves on nodes, over real SSH: the next command ends it, and loses no node behind another."""

from __future__ import annotations

import json
import signal
from collections.abc import Iterator
from typing import Any

import pytest

from tests import waiting
from tests.meshctl.proof.rig import Rig

pytestmark = [pytest.mark.lab, pytest.mark.xdist_group("dead changes")]


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    with Rig(tmp_path_factory.mktemp("rig"), count=3, window_s=300, is_chain=True) as made:
        made.take_in("a")
        for name in made.names:
            made.fleet.node(name).plug(False)
        yield made


def kill_after_the_switch(rig: Rig) -> None:
    """Kill meshctl when all nodes have moved to the other channel, before any of them is confirmed."""
    ordered = set()
    with rig.start("provision", "split", "--yes", "--json") as process:
        assert process.stdout is not None
        for line in process.stdout:
            event = json.loads(line)
            if event.get("text") == "apply":
                ordered.add(event["node"])
            if "change simultaneously" in event.get("text", ""):
                break
        process.send_signal(signal.SIGKILL)
    assert ordered == {"base", *rig.names}
    for name in ("base", *rig.names):
        wait_until_it_has_moved(rig, name)


def answering(rig: Rig) -> list[dict[str, Any]]:
    """The nodes that answer `meshctl status`, which changes nothing."""
    return [node for node in json.loads(rig.meshctl("status", "split", "--json").out)["nodes"] if node["answers"]]


def wait_until_it_has_moved(rig: Rig, name: str) -> None:
    waiting.until(lambda: rig.state_of(name, "a", "split") == "new", f"{name} to have the new files")


def test_a_killed_change_of_the_mesh_is_rolled_back_on_all_nodes_before_the_next_plan(rig: Rig) -> None:
    kill_after_the_switch(rig)
    # in the other cell; what the next command ends is no alarm
    waiting.until(lambda: len(answering(rig)) == 4, "all nodes to answer")
    assert "refused" not in {alarm["code"] for node in answering(rig) for alarm in node["alarms"]}
    planned = rig.meshctl("plan", "split", "--json")
    assert planned.code == 0, planned.out + planned.err
    verdicts = {node["node"]: node["verdict"] for node in json.loads(planned.out)["nodes"]}
    assert verdicts == dict.fromkeys(("base", *rig.names), "change")
    assert {rig.state_of(name, "a", "split") for name in ("base", *rig.names)} == {"old"}


def test_a_node_that_may_still_roll_back_is_not_to_be_left_behind(rig: Rig) -> None:
    kill_after_the_switch(rig)
    rig.fleet.inject_fault("n003", "off")
    try:
        planned = rig.meshctl("plan", "split")
        assert planned.code == 1
        text = " ".join(planned.out.split())
        assert "refused: mesh main changes its cell, and" in text
        assert "n003 may still roll back an earlier change" in text
        assert "--leave-behind" not in text + planned.err
        seen = json.loads(rig.meshctl("status", "split", "--json").out)
        (hint,) = [alarm["hint"] for node in seen["nodes"] if node["name"] == "n003" for alarm in node["alarms"]]
        assert hint.startswith("it may roll back a change: wait up to ")
    finally:
        rig.fleet.repair("n003")
        rig.wait_all_up()
