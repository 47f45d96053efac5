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
    """Kill meshctl before any node is confirmed, and wait until all have moved to the other channel."""
    # the nodes may still be reloading after a rollback; a change without all of them is refused
    waiting.until(lambda: is_begun_and_killed(rig), "the change to begin", wait_s=180.0)
    for name in ("base", *rig.names):
        wait_until_it_has_moved(rig, name)
    waiting.until(lambda: len(answering(rig)) == 4, "all nodes to answer")


def is_begun_and_killed(rig: Rig) -> bool:
    with rig.start("provision", "split", "--yes", "--json") as process:
        assert process.stdout is not None
        begun = any("change simultaneously" in json.loads(line).get("text", "") for line in process.stdout)
        process.send_signal(signal.SIGKILL)
    return begun


def answering(rig: Rig) -> list[dict[str, Any]]:
    """The nodes that answer `meshctl status`, which changes nothing."""
    return [node for node in json.loads(rig.meshctl("status", "split", "--json").out)["nodes"] if node["answers"]]


def wait_until_it_has_moved(rig: Rig, name: str) -> None:
    def has_moved() -> bool:
        status = rig.fleet.node(name).exec("/usr/sbin/meshctl-deadman status").stdout.split()
        return {"state=applied", "reload_status=0"} <= set(status)

    waiting.until(has_moved, f"{name} to move")
    assert rig.state_of(name, "a", "split") == "new"


def test_a_killed_change_of_the_mesh_is_rolled_back_on_all_nodes_before_the_next_plan(rig: Rig) -> None:
    kill_after_the_switch(rig)
    # what the next command ends is no alarm
    assert "refused" not in {alarm["code"] for node in answering(rig) for alarm in node["alarms"]}
    planned = rig.meshctl("plan", "split", "--json")
    assert planned.code == 0, planned.out + planned.err
    verdicts = {node["node"]: node["verdict"] for node in json.loads(planned.out)["nodes"]}
    assert verdicts == dict.fromkeys(("base", *rig.names), "change")
    assert {rig.state_of(name, "a", "split") for name in ("base", *rig.names)} == {"old"}


def test_a_backup_after_a_killed_change_of_the_mesh_reaches_all_nodes(rig: Rig) -> None:
    kill_after_the_switch(rig)
    # it changes no configuration, so it needs no journal
    state = rig.directory / "no-directory"
    state.touch()
    folder = rig.directory / "backups"
    saved = rig.meshctl("backup", "split", "--out", str(folder), "--json", environ={"XDG_STATE_HOME": str(state)})
    results = {event["node"]: event["outcome"]["result"] for event in saved.events if event["event"] == "finished"}
    assert results == dict.fromkeys(("base", *rig.names), "done"), saved.out + saved.err
    assert "continuing without recording" in saved.err
    assert len(list(folder.iterdir())) == 4


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
