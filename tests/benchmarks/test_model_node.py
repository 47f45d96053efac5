"""Model nodes: meshctl changes one as it changes a router, and a command that the model does not know has no answer."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.model_node.fleet import ModelFleet
from benchmarks.model_node.node import Node, UnknownCommand, recorded_costs, recorded_sections, takes_input
from meshctl.apply.stale_stations import StationEntry, flush_script, reconnect_script, watch_script


def model_node() -> Node:
    return Node(
        "n002", "10.42.1.3", {"etc/config/system": b"config system\n"}, "6", recorded_costs(), recorded_sections()
    )


def test_an_unknown_command_has_no_answer() -> None:
    with pytest.raises(UnknownCommand):
        model_node().answer("rm -rf /", b"", 0.0)


def test_what_meshctl_says_to_a_neighbor_is_known() -> None:
    """A benchmark of chains lost these commands without a word when their scripts changed."""
    entries = [StationEntry("n001", "wlan0", "02:00:00:00:00:01")]
    scripts = (
        watch_script("n002", entries, for_s=60.0),
        flush_script(entries, older_than_s=9.0),
        reconnect_script(entries, caught_up=1, logins={}),
    )
    assert all(model_node().answer(script, b"", 0.0).busy_s > 0 for script in scripts)


def test_an_answer_takes_as_long_as_recorded_on_a_router() -> None:
    node = model_node()
    answer = node.answer("/usr/sbin/meshctl-deadman status", b"", 10.0)
    assert answer.busy_s == recorded_costs()["status"].seconds > 0
    assert (node.processes, node.syncs) == (recorded_costs()["status"].processes, 0)
    assert b" state=idle " in answer.output


def test_stdin_is_read_only_for_commands_that_take_input() -> None:
    assert takes_input("/usr/sbin/meshctl-deadman change a 1 c1 n 60 30 d")
    assert takes_input("dd of=/root/.ansible/tmp/x/n001.sh bs=65536")
    assert not takes_input("cat /etc/openwrt_release")


@pytest.mark.lab
def test_meshctl_changes_a_model_node_with_four_commands(tmp_path: Path) -> None:
    fleet = ModelFleet(tmp_path, 1)
    command = [sys.executable, "-m", "meshctl", "provision", "--yes", "--json", "-i", str(fleet.inventory("b"))]
    costs = recorded_costs()
    with fleet.running() as nodes:
        done = subprocess.run(
            [*command, "--key", str(fleet.key)], env=fleet.environ, capture_output=True, text=True, check=False
        )
        counts = nodes.counts()
    last = json.loads(done.stdout.splitlines()[-1])
    assert [(item["node"], item["result"]) for item in last["outcomes"]] == [("n001", "done")], (
        done.stdout + done.stderr
    )
    # observed twice, changed, confirmed: nothing else
    kinds = ("observe", "observe", "change", "reload", "confirm")
    assert counts == {
        "processes": sum(costs[kind].processes for kind in kinds),
        "syncs": sum(costs[kind].syncs for kind in kinds),
    }
