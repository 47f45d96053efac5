"""The commands of provisioning against a real virtual fleet, as an operator uses them one after the other.

One fleet serves all tests of this file, in their order.
"""

from __future__ import annotations

import json
import signal
from collections.abc import Iterator

import pytest

from meshctl.inventory import load_fleet
from tests.meshctl.proof.rig import Ended, Rig

pytestmark = [pytest.mark.lab, pytest.mark.xdist_group("lab"), pytest.mark.timeout(600)]


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    with Rig(tmp_path_factory.mktemp("commands"), 3) as started:
        taken = started.take_in("a")
        assert taken.code == 0, taken.err
        yield started


def test_a_saved_plan_is_applied_exactly_and_a_node_that_moved_on_is_refused(rig: Rig) -> None:
    file = rig.directory / "plan.json"
    assert rig.meshctl("plan", "b", "--brief", "--out", str(file)).code == 0
    rig.fleet.node("n001").exec("uci set system.@system[0].log_size=999 && uci commit system").check("edit by hand")
    applied = rig.meshctl("apply", "b", str(file), "--json")
    assert (applied.code, applied.results) == (
        1,
        {"base": "done", "n001": "refused", "n002": "done", "n003": "done"},
    ), applied.err
    assert rig.state_of("n002", "a", "b") == "new"
    again = rig.meshctl("apply", "b", str(file), "--json")
    assert set(again.results.values()) == {"refused"}


def test_drift_is_told_by_the_exit_code_and_provisioning_mends_it(rig: Rig) -> None:
    drifted = rig.meshctl("provision", "b", "--check", "--json")
    assert (drifted.code, drifted.verdicts["n001"], drifted.verdicts["n002"]) == (1, "change", "same")
    assert rig.meshctl("provision", "b", "n001", "--yes", "--json").results == {"n001": "done"}
    assert rig.meshctl("provision", "b", "--check", "--json").code == 0


def test_ctrl_c_ends_the_nodes_in_work_properly_and_a_resume_takes_up_the_rest(rig: Rig) -> None:
    said: list[str] = []
    with rig.start("provision", "a", "--yes", "--json") as process:
        assert process.stdout is not None
        for line in process.stdout:
            said.append(line)
            if json.loads(line)["event"] == "step":
                process.send_signal(signal.SIGINT)
                break
        rest, err = process.communicate()
    ended = Ended(process.returncode, "".join(said) + rest, err)
    assert ended.code == 130, err
    left = {name for name, result in ended.results.items() if result == "pending"}
    assert {result for name, result in ended.results.items() if name not in left} == {"done"}
    assert "base" in left
    resumed = rig.meshctl("resume", "a", "--yes", "--json")
    assert (resumed.code, resumed.results) == (0, dict.fromkeys(sorted(left), "done")), resumed.err


def test_a_backup_brings_back_what_was(rig: Rig) -> None:
    assert rig.meshctl("backup", "a", "n001", "--out", str(rig.directory / "backups")).code == 0
    (file,) = (rig.directory / "backups").iterdir()
    assert file.stat().st_mode & 0o077 == 0
    assert rig.meshctl("provision", "b", "n001", "--yes", "--json").code == 0
    restored = rig.meshctl("restore", "a", "n001", str(file), "--yes")
    assert restored.code == 0, restored.out + restored.err
    assert rig.state_of("n001", "b", "a") == "new"
    wrong = rig.meshctl("restore", "a", "n002", str(file), "--yes")
    assert "the backup is of n001, not of n002" in wrong.err


def test_a_command_runs_on_all_nodes_and_a_failure_is_told(rig: Rig) -> None:
    done = rig.meshctl("run", "a", "n*", command=["grep", "^node=", "/etc/meshctl/node"])
    assert (done.code, sorted(done.out.split())) == (
        0,
        ["n001:", "n002:", "n003:", "node=n001", "node=n002", "node=n003"],
    )
    failed = rig.meshctl("run", "a", "n001", command=["false"])
    assert (failed.code, failed.err) == (1, "n001: exit status 1\n")


def test_a_spare_takes_over_a_dead_nodes_name_address_and_pin(rig: Rig) -> None:
    inventory = rig.inventory("spare")
    text = rig.inventory("a").read_text(encoding="utf-8")
    inventory.write_text(text + "  n003: {state: spare, label: S1}\n", encoding="utf-8")
    alive = rig.meshctl("replace", "spare", "n002", "n003", "--yes", "--json")
    assert "still answers" in alive.err
    rig.fleet.break_("n002", "off")
    replaced = rig.meshctl("replace", "spare", "n002", "n003", "--yes", "--json")
    assert (replaced.code, replaced.results) == (0, {"n002": "done"}), replaced.out + replaced.err
    assert rig.fleet.node("n003").address == "10.42.1.2"
    fleet = load_fleet(inventory)
    assert (fleet.nodes["n002"].label, fleet.nodes["n003"].state.value) == ("S1", "retired")
    assert rig.meshctl("provision", "spare", "n002", "--check", "--json").verdicts == {"n002": "same"}


def test_the_journal_tells_every_run_with_its_steps(rig: Rig) -> None:
    runs = json.loads(rig.meshctl("history", "", "--json").out)
    assert [run["command"] for run in runs[-3:]] == ["apply", "apply", "bootstrap"]
    first = json.loads(rig.meshctl("history", "", "1", "--json").out)
    assert [step["step"] for step in first["steps"] if step["node"] == "n001"] == ["stage", "arm", "apply", "prove"]
    assert {outcome["result"] for outcome in first["outcomes"]} == {"done"}
