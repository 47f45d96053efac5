"""The commands of provisioning against a real virtual fleet, as an operator uses them one after the other."""

from __future__ import annotations

import json
import re
import signal
import subprocess
from pathlib import Path

import pytest

from tests.meshctl.proof.rig import Ended, Rig, run

pytestmark = [pytest.mark.lab, pytest.mark.xdist_group("fleet")]


def test_an_up_to_date_fleet_needs_no_changes(rig: Rig) -> None:
    again = rig.meshctl("provision", rig.current, "--check", "--json")
    assert (again.code, set(again.verdicts.values())) == (0, {"same"}), again.err


def test_a_saved_plan_is_applied_and_a_node_changed_since_is_refused(rig: Rig) -> None:
    old, new = rig.flip()
    file = rig.directory / "plan.json"
    assert rig.meshctl("plan", new, "--brief", "--out", str(file)).code == 0
    rig.fleet.node("n001").exec("uci set system.@system[0].log_size=999 && uci commit system").check("edit by hand")
    applied = rig.meshctl("apply", new, str(file), "--yes", "--json")
    expected = {name: "refused" if name == "n001" else "done" for name in ("base", *rig.names)}
    assert (applied.code, applied.results) == (1, expected), applied.err
    assert rig.state_of("n002", old, new) == "new"
    again = rig.meshctl("apply", new, str(file), "--dry-run")
    assert (again.code, "5 refused" in again.out) == (1, True), again.out + again.err
    drifted = rig.meshctl("provision", new, "--check", "--json")
    assert (drifted.code, drifted.verdicts["n001"], drifted.verdicts["n002"]) == (1, "change", "same")
    assert rig.meshctl("provision", new, "n001", "--yes", "--json").results == {"n001": "done"}


def test_a_non_radio_change_is_confirmed_over_a_new_login_after_the_proof(rig: Rig) -> None:
    """An effect that nothing showed could refuse logins after the proof; settings of radios cannot."""
    before_radio, before_system = (_before_confirmation(rig, key) for key in ("distance_m", "log_size_kib"))
    assert (before_radio, before_system) == ("command", "connected")
    rig.settle()


def _before_confirmation(rig: Rig, key: str) -> str:
    """What meshctl did on n001 right before it confirmed a change of one value: `command`, or `connected`."""
    text = rig.inventory(rig.current).read_text(encoding="utf-8")
    rig.inventory(key).write_text(re.sub(rf"({key}: )\d+", r"\g<1>777", text), encoding="utf-8")
    log = rig.directory / f"{key}.log"
    changed = rig.meshctl("provision", key, "n001", "--yes", "--json", "--log-file", str(log))
    assert changed.results == {"n001": "done"}, changed.out + changed.err
    events = [json.loads(line) for line in log.read_text(encoding="utf-8").splitlines()]
    own = [event for event in events if event.get("device", "").startswith("n001 ")]
    (at,) = (place for place, event in enumerate(own) if "meshctl-deadman confirm" in event.get("script", ""))
    return str(own[at - 1]["event"])


def test_a_dry_run_shows_the_plan_and_changes_nothing(rig: Rig) -> None:
    before = rig.meshctl("history", "", "--json").out
    other = "b" if rig.current == "a" else "a"
    shown = rig.meshctl("provision", other, "--brief", "--dry-run")
    assert (shown.code, "5 to change" in shown.out) == (0, True), shown.out + shown.err
    assert rig.meshctl("plan", other, "--brief").out == shown.out
    file = rig.directory / "dry.json"
    assert rig.meshctl("plan", other, "--brief", "--out", str(file)).code == 0
    assert json.loads(rig.meshctl("apply", other, str(file), "--dry-run", "--json").out)["fleet"] == "proof"
    assert {rig.state_of(name, rig.current, other) for name in ("base", *rig.names)} == {"old"}
    assert rig.meshctl("history", "", "--json").out == before


def test_a_rollback_restores_the_old_state_and_refuses_a_bootstrap(rig: Rig) -> None:
    old, new = rig.flip()
    provisioned = rig.meshctl("provision", new, "--yes", "--json")
    number = str(provisioned.events[-1]["run"])
    changes = json.loads(rig.meshctl("history", "", number, "--json").out)["changes"]
    assert {change["node"] for change in changes} == {"base", *rig.names}
    assert any("log_size" in change["diff"] for change in changes)
    assert "log_size" in rig.meshctl("history", "", number, "--node", "n001").out
    shown = rig.meshctl("rollback", new, number, "--dry-run", "--brief")
    assert (shown.code, "5 to change" in shown.out) == (0, True), shown.out + shown.err
    one = rig.meshctl("rollback", new, number, "n001", "--yes", "--json")
    assert (one.code, one.results) == (0, {"n001": "done"}), one.out + one.err
    assert "the inventory still describes run" in one.err
    assert rig.state_of("n001", old, new) == "old"
    rest = rig.meshctl("rollback", new, number, "--yes", "--json")
    assert "n001: cannot be rolled back: run" in rest.err
    assert rest.results == dict.fromkeys(("base", *rig.names[1:]), "done"), rest.out + rest.err
    assert {rig.state_of(name, old, new) for name in ("base", *rig.names)} == {"old"}
    rig.current = old
    factory = rig.meshctl("rollback", old, "1", "--yes")
    assert (factory.code, "run 1 was a bootstrap and cannot be rolled back" in factory.err) == (1, True)


def test_a_channel_rollback_switches_the_whole_mesh_at_once(rig: Rig) -> None:
    before = rig.current
    moved = rig.meshctl("provision", "split", "--yes", "--json")
    assert moved.code == 0, moved.out + moved.err
    back = rig.meshctl("rollback", "split", str(moved.events[-1]["run"]), "--yes", "--json")
    assert (back.code, set(back.results.values())) == (0, {"done"}), back.out + back.err
    plan = rig.meshctl("history", "", str(back.events[-1]["run"]), "--json").out
    assert "switch" in plan or "channel" in plan
    assert {rig.state_of(name, "split", before) for name in ("base", *rig.names)} == {"new"}


def test_ctrl_c_finishes_active_nodes_and_resume_continues_the_rest(rig: Rig) -> None:
    _, new = rig.flip()
    said: list[str] = []
    events: list[str] = []
    with rig.start("provision", new, "--yes", "--json") as process:
        assert process.stdout is not None
        for line in process.stdout:
            said.append(line)
            events.append(json.loads(line)["event"])
            # what is done for nodes before any begins is no work to be ended properly
            if events[-1] == "step" and "started" in events:
                process.send_signal(signal.SIGINT)
                break
        rest, err = process.communicate()
    ended = Ended(process.returncode, "".join(said) + rest, err)
    assert ended.code == 130, err
    left = {name for name, result in ended.results.items() if result == "pending"}
    assert {result for name, result in ended.results.items() if name not in left} == {"done"}
    assert "base" in left
    resumed = rig.meshctl("resume", new, "--yes", "--json")
    assert (resumed.code, resumed.results) == (0, dict.fromkeys(sorted(left), "done")), resumed.err


def test_a_backup_restores_the_previous_configuration(rig: Rig, tmp_path: Path) -> None:
    folder = tmp_path / "backups"
    assert rig.meshctl("backup", rig.current, "n001", "--out", str(folder)).code == 0
    (file,) = folder.iterdir()
    assert file.stat().st_mode & 0o077 == 0
    rig.fleet.node("n001").exec("uci set system.@system[0].log_size=999 && uci commit system").check("edit by hand")
    shown = rig.meshctl("restore", rig.current, "n001", str(file), "--dry-run", "--json")
    assert json.loads(shown.out)["files"] == ["/etc/config/system"], shown.out + shown.err
    restored = rig.meshctl("restore", rig.current, "n001", str(file), "--yes", "--json")
    assert restored.events[-1]["run"] == json.loads(rig.meshctl("history", "", "--json").out)[0]["run"]
    assert restored.results == {"n001": "done"}
    assert restored.code == 0, restored.out + restored.err
    assert rig.state_of("n001", "split", rig.current) == "new"
    wrong = rig.meshctl("restore", rig.current, "n002", str(file), "--yes")
    assert "the backup is of node n001, not n002" in wrong.err


def test_a_command_runs_on_all_nodes_and_a_failure_is_reported(rig: Rig) -> None:
    done = rig.meshctl("run", rig.current, "n*", command=["grep", "^node=", "/etc/meshctl/node"])
    assert (done.code, sorted(done.out.splitlines())) == (0, [f"{name}: node={name}" for name in rig.names])
    failed = rig.meshctl("run", rig.current, "n001", command=["false"])
    assert (failed.code, failed.err) == (1, "n001: exit status 1\n")


def test_openssh_logs_in_with_the_configuration_exported_in_the_lab(rig: Rig, tmp_path: Path) -> None:
    exported = run(["inventory", "export", "-i", str(rig.inventory(rig.current))], rig.environ)
    file = tmp_path / "ssh_config"
    # the rig's inventory names no key
    file.write_text(f"Host *\n    IdentityFile {rig.directory / 'key'}\n{exported.out}", encoding="utf-8")
    words = ["ssh", "-F", str(file), "-o", "BatchMode=yes", "n001", "grep ^node= /etc/meshctl/node"]
    done = subprocess.run(words, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout) == (0, "node=n001\n"), done.stderr


def test_a_dry_run_of_trust_pins_nothing(rig: Rig) -> None:
    pins = rig.directory / "known_hosts"
    before = pins.read_text(encoding="utf-8")
    others = [line for line in before.splitlines(keepends=True) if not line.startswith("n001 ")]
    pins.write_text("".join(others), encoding="utf-8")
    try:
        shown = rig.meshctl("trust", rig.current, "n001", "n002", "--dry-run", "--yes")
        assert (shown.code, shown.out.count("would be pinned")) == (0, 1), shown.out + shown.err
        assert pins.read_text(encoding="utf-8") == "".join(others)
    finally:
        pins.write_text(before, encoding="utf-8")


def test_the_journal_records_each_run_with_its_steps(rig: Rig) -> None:
    first = json.loads(rig.meshctl("history", "", "1", "--json").out)
    assert (first["command"], {outcome["result"] for outcome in first["outcomes"]}) == ("bootstrap", {"done"})
    steps = [step["step"] for step in first["steps"] if step["node"] == "n001"]
    # on a slow machine the node may seem unreachable, so that its neighbors are queried meanwhile
    assert [step for step in steps if not step.endswith("neighbor station entries")] == ["apply", "prove"]
