"""Sites of virtual nodes are provisioned by their workers, over real SSH, with uplinks that are cut.

Each test ends with all nodes as the inventory has them.
"""

from __future__ import annotations

import gzip
import json
import os
import re
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from meshctl.plan.radios import SLACK_S
from meshctl.sites.runs import SiteDirectory, closing
from meshlab.fleet import VirtualFleet, VirtualNode
from tests.meshctl.sites.rig import LIMIT_S, NORTH, SECRETS, SOUTH, SitesRig
from tests.waiting import until

pytestmark = [pytest.mark.lab, pytest.mark.xdist_group("sites")]
_EVERY = (*NORTH, *SOUTH)
_PROVISION = ("provision", "--yes", "--json")
# the canary of north: the others follow
_AT_WORK = '"node": "n[12]", "at_s": [0-9.]*, "text": "apply"'


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SitesRig]:
    with SitesRig(tmp_path_factory.mktemp("sites")) as started:
        yield started


@pytest.fixture
def rig(shared: SitesRig) -> SitesRig:
    for uplink in shared.uplinks.values():
        uplink.mend()
    return shared


def test_status_sees_the_nodes_through_the_worker_and_how_old_they_are_without(
    rig: SitesRig, monkeypatch: pytest.MonkeyPatch
) -> None:
    # a worker of another version than this meshctl: the nodes are queried from here
    protocol = rig.gateway / "root/.local/share/meshctl/current/lib/meshctl/sites/protocol.py"
    text = protocol.read_text()
    # of another length: bytecode is kept for a file of the same size and second
    protocol.write_text(text.replace("PROTOCOL = 1\n", "PROTOCOL = 100\n"))
    old = json.loads(rig.run("status", "--json", expected=0).out)
    protocol.write_text(text)
    notes = [alarm for alarm in old["alarms"] if alarm["code"] == "site"]
    assert [alarm["hint"] for alarm in notes] == [f"run `meshctl sites install {site}`" for site in SECRETS]
    assert all("were queried from here, not by its worker" in alarm["text"] for alarm in notes)
    # without it no node can be reached from here, nor from the gateway by an address
    monkeypatch.delitem(rig.environment, "MESHCTL_LAB")
    seen = json.loads(rig.run("status", "--json", expected=0).out)
    assert {node["name"]: node["health"] for node in seen["nodes"]} == dict.fromkeys(_EVERY, "ok")
    assert rig.run("status", "--direct", "--timeout", "2", "--json").code == 3
    rig.uplinks["north"].cut()
    ended = rig.run("status", "--json")
    assert ended.code == 3
    found = json.loads(ended.out)
    (alarm,) = (alarm for alarm in found["alarms"] if alarm["code"] == "site")
    assert re.search(r"no contact with site north .*: the last known state of its 3 nodes is \d+ s old", alarm["text"])
    assert {node["name"]: node["health"] for node in found["nodes"]} == {
        **dict.fromkeys(NORTH, "unreachable"),
        **dict.fromkeys(SOUTH, "ok"),
    }


def test_all_sites_change_in_one_run_without_the_secrets_of_each_other(rig: SitesRig) -> None:
    power_dbm = rig.change_power()
    planned = rig.run("provision", "--check")
    assert planned.code == 1
    assert "site north:" in planned.out
    assert "3 to change" in planned.out
    started = rig.start(*_PROVISION)
    inventory = until(lambda: next(rig.site_directory("north").glob("runs/*/inventory"), None), "the part of north")
    secrets = until(lambda: _text(inventory / "secrets.yaml"), "its secrets")
    assert SECRETS["north"] in secrets
    assert SECRETS["south"] not in secrets
    assert "s-base" not in (_text(inventory / "fleet.yaml") or "")
    done = started.end()
    assert (done.code, done.results) == (0, dict.fromkeys(_EVERY, "done"))
    assert set(rig.powers().values()) == {str(power_dbm)}
    assert _files_with_secrets(rig.site_directory("north")) == []
    history = json.loads(rig.run("history", "--json", expected=0).out)
    assert (history[0]["command"], history[0]["state"]) == ("provision", "4 done")


def _files_with_secrets(directory: Path) -> list[Path]:
    """The journal's files are compressed."""
    files = [path for path in directory.rglob("*") if path.is_file()]
    assert files
    return [path for path in files if any(secret.encode() in _content(path) for secret in SECRETS.values())]


def _content(path: Path) -> bytes:
    return gzip.decompress(path.read_bytes()) if path.suffix == ".gz" else path.read_bytes()


def _latest_run(rig: SitesRig) -> str:
    return str(json.loads(rig.run("history", "--json", expected=0).out)[0]["run"])


def _text(path: Path) -> str | None:
    try:
        return path.read_text()
    except FileNotFoundError:
        return None


def test_a_site_continues_while_its_uplink_is_cut_and_takes_no_second_run(rig: SitesRig) -> None:
    rig.change_power()
    holder = {"run": "0123456789abcdef", "operator": "ann@laptop", "command": "provision"}
    with closing(SiteDirectory(rig.site_directory("north")).lock(holder)):
        second = rig.run("provision", *NORTH, "--yes", "--json")
    reasons = [event["outcome"]["reason"] for event in second.events if event["event"] == "finished"]
    assert second.code == 1
    assert len(reasons) == len(NORTH)
    busy = "run 0123456789abcdef of ann@laptop (provision) is in progress at this site"
    assert all(busy in reason for reason in reasons), second
    first = rig.start(*_PROVISION)
    first.wait_for(_AT_WORK)
    rig.uplinks["north"].cut()
    run = rig.started_run("north")
    first.wait_for("connecting again, the site continues on its own")
    until(lambda: (run / "over.json").exists(), "the end of the run at the site", wait_s=120)
    rig.uplinks["north"].mend()
    ended = first.end()
    assert (ended.code, ended.results) == (0, dict.fromkeys(_EVERY, "done"))


def test_a_run_whose_operator_died_is_met_again(rig: SitesRig) -> None:
    power_dbm = rig.change_power()
    started = rig.start(*_PROVISION)
    started.wait_for(_AT_WORK)
    os.killpg(started.process.pid, signal.SIGKILL)
    started.process.wait()
    met = rig.run("resume", "--yes", expected=0)
    assert "asking north" in met.out
    assert "is finished: nothing to resume" in met.out
    assert set(rig.powers().values()) == {str(power_dbm)}
    history = json.loads(rig.run("history", "--json", expected=0).out)
    assert history[0]["state"] == "4 done"


@pytest.mark.proof
def test_an_interrupt_stops_the_sites_and_a_second_one_leaves_them(rig: SitesRig) -> None:
    rig.change_power()
    started = rig.start(*_PROVISION)
    started.wait_for(_AT_WORK)
    started.signal(signal.SIGINT)
    ended = started.end()
    assert ended.code == 130
    assert set(ended.results.values()) == {"done", "pending"}
    assert "in progress" not in rig.runs_at("north").values()
    resumed = rig.start("resume", "--yes", "--json")
    resumed.wait_for('"node": "n[-a-z0-9]*", "at_s": [0-9.]*, "text": "apply"')
    resumed.signal(signal.SIGINT)
    resumed.wait_for("stopping")
    resumed.signal(signal.SIGINT)
    assert resumed.end().code == 130
    until(lambda: rig.run("resume", "--yes", "--json").code == 0, "all nodes to be as planned", wait_s=240)
    assert rig.run("provision", "--check").code == 0


def test_a_site_that_cannot_be_reached_or_refuses_keeps_no_other_from_its_change(rig: SitesRig) -> None:
    rig.uplinks["south"].cut()
    checked = rig.run("provision", "--check", "--json", expected=3)
    verdicts = {name: node["verdict"] for name, node in json.loads(checked.out)["nodes"].items()}
    assert verdicts == {**dict.fromkeys(NORTH, "same"), **dict.fromkeys(SOUTH, "away")}
    status = rig.run("status", expected=3).out
    assert "s-base: gateway of south: " in status
    assert "check the uplink of south" in status
    rig.change_power()
    assert rig.run("provision", "--check").code == 1
    ended = rig.run(*_PROVISION)
    assert ended.code == 3
    assert ended.results == {**dict.fromkeys(NORTH, "done"), **dict.fromkeys(SOUTH, "unreachable")}
    rig.uplinks["south"].mend()
    operators = rig.site_directory("south") / "operators"
    kept = operators.read_text()
    operators.write_text("ssh-ed25519 AAAAC3NzaC1lZDI1NTE5AAAAIAECAwQFBgcICQoLDA0ODxAREhMUFRYXGBkaGxwdHh8g other\n")
    refused = rig.run("resume", "--yes", "--json")
    operators.write_text(kept)
    assert refused.code == 2
    assert "none of those keys is here" in refused.err
    assert rig.run("resume", "--yes", "--json", expected=0).results == dict.fromkeys(SOUTH, "done")


def test_workers_query_the_nodes_and_other_commands_pass_through_the_gateway(rig: SitesRig) -> None:
    said = rig.run("sites", "status", "--nodes")
    assert re.search(r"north  3 ok; meshctl \S+, \w+ by \S+ .* ago: over", said.out), said
    found = json.loads(rig.run("sites", "status", "north", "--nodes", "--json").out)
    assert {node["name"]: node["health"] for node in found[0]["status"]["nodes"]} == dict.fromkeys(NORTH, "ok")
    before = rig.uplinks["south"].accepted
    assert rig.run("run", "s-base", "--", "uname", expected=0).out == "s-base: Linux\n"
    assert rig.uplinks["south"].accepted == before + 1
    rig.uplinks["south"].cut()
    assert "check the uplink of south" in rig.run("run", "s-base", "--", "uname").err
    cut = rig.run("sites", "status")
    assert cut.code == 1
    assert "check the uplink of south" in cut.out


@pytest.mark.proof
def test_a_run_whose_processes_die_at_the_site_is_reported_and_resumed(rig: SitesRig) -> None:
    rig.change_power()
    started = rig.start(*_PROVISION)
    started.wait_for(_AT_WORK)
    for line in (rig.started_run("north") / "process").read_text().splitlines():
        rig.kill(int(line.split(":")[1]))
    ended = started.end()
    assert ended.code == 1
    assert ended.results["s-base"] == "done"
    assert "uncertain" in ended.results.values()
    # the node that was armed goes back by itself, within its window
    until(lambda: rig.run("resume", "--yes", "--json").code == 0, "the nodes to be as planned", wait_s=240)
    assert rig.run("provision", "--check").code == 0


@pytest.mark.proof
def test_a_run_at_sites_is_rolled_back_by_their_workers(rig: SitesRig) -> None:
    before = rig.powers()
    rig.change_power()
    rig.run(*_PROVISION, expected=0)
    run = _latest_run(rig)
    assert "txpower" in rig.run("history", run, "--node", "n1", expected=0).out
    shown = rig.run("rollback", run, "--dry-run", expected=0)
    assert "site south:" in shown.out
    done = rig.run("rollback", run, "--yes", "--json", expected=0)
    assert done.results == dict.fromkeys(_EVERY, "done")
    assert f"the inventory still describes run {run}" in done.err
    assert rig.powers() == before
    for site in SECRETS:
        assert _files_with_secrets(rig.site_directory(site)) == []
    again = rig.run("rollback", run, "--yes")
    assert again.code == 1
    assert "has rolled it back already" in again.err
    rig.change_power()
    assert rig.run("provision", "--check").code == 0


@pytest.mark.proof
def test_a_run_whose_operator_died_is_met_by_its_rollback(rig: SitesRig) -> None:
    before = rig.powers()
    rig.change_power()
    started = rig.start(*_PROVISION)
    started.wait_for(_AT_WORK)
    os.killpg(started.process.pid, signal.SIGKILL)
    started.process.wait()
    run = _latest_run(rig)
    done = rig.run("rollback", run, "--yes", expected=0)
    assert "asking north" in done.out
    assert rig.powers() == before
    rig.change_power()
    assert rig.run("provision", "--check").code == 0


@pytest.mark.proof
def test_a_saved_plan_is_applied_by_the_workers_as_it_was_shown_or_refused(rig: SitesRig, tmp_path: Path) -> None:
    file = tmp_path / "plan.json"
    power_dbm = rig.change_power()
    rig.uplinks["south"].cut()
    assert rig.run("plan", "--out", str(file), "--brief").code == 1
    rig.uplinks["south"].mend()
    partly = rig.run("apply", str(file), "--dry-run")
    assert "has no plan of site south" in partly.out
    rig.run("plan", "--out", str(file), expected=0)
    assert not any(secret in file.read_text() for secret in SECRETS.values())
    rig.run("run", "n1", "--", "uci set wireless.radio0.txpower=20; uci commit wireless", expected=0)
    stale = rig.run("apply", str(file), "--json")
    assert stale.code == 1
    assert stale.results == {**dict.fromkeys(_EVERY, "done"), "n1": "refused"}
    assert "the node has changed since the plan was made" in stale.out
    rig.run("plan", "--out", str(file), expected=0)
    applied = rig.run("apply", str(file), "--json", expected=0)
    assert applied.results == {**dict.fromkeys(_EVERY, "unchanged"), "n1": "done"}
    assert set(rig.powers().values()) == {str(power_dbm)}
    rig.run("plan", "--out", str(file), expected=0)
    rig.change_power()
    late = rig.run("apply", str(file), "--json")
    assert set(late.results.values()) == {"refused"}, late
    rig.run(*_PROVISION, expected=0)
    assert _files_with_secrets(rig.site_directory("north")) == []


@pytest.mark.proof
def test_a_node_that_is_back_in_its_mesh_but_unreachable_is_reached_by_the_worker(rig: SitesRig) -> None:
    """Its radio counts its frames from 0 again, and its neighbor at the site drops them (docs/lab.md)."""
    # the worker learns who hears whom
    rig.run("provision", *NORTH, "--check", expected=0)
    lab = VirtualFleet.attach(rig.lab)
    # no other node is behind this one
    holders = [lab.node(name) for name in NORTH if name != "n2"]
    until(lambda: all(_known_for_s(holder) > SLACK_S + 2 for holder in holders), "its neighbors to know it for a while")
    # the watches of its last change would remove the entry by themselves
    end_watches = "for f in /tmp/meshctl/forget.*.pid; do [ ! -f $f ] || kill $(cat $f); done; true"
    for holder in holders:
        holder.exec(end_watches).check("end its watches")
    lab.node("n2").exec("wifi down; wifi").check("restart its radio")
    # what changes nothing leaves station entries alone, too
    is_dropped = re.compile(r"^n2 +away: .*heard by n", re.MULTILINE)
    until(lambda: is_dropped.search(rig.run("plan", "n2", "--brief").out), "its frames to be dropped", wait_s=LIMIT_S)
    ended = rig.run("provision", *NORTH, "--yes", "--json", expected=0)
    assert ended.results == dict.fromkeys(NORTH, "unchanged")


def _known_for_s(holder: VirtualNode) -> int:
    """For how long it has known the radio that it has heard for the shortest time."""
    dump = holder.exec("iw dev mesh0 station dump").check(f"{holder.name}: stations").stdout
    return min(map(int, re.findall(r"connected time:\s*(\d+)", dump)), default=0)


def test_backup_restore_and_replace_reach_nodes_through_the_gateway(rig: SitesRig, tmp_path: Path) -> None:
    """The last one here: afterwards the site has a node less."""
    rig.change_power()
    rig.run(*_PROVISION, expected=0)
    rig.run("backup", "n1", "--out", str(tmp_path), expected=0)
    rig.change_power()
    rig.run(*_PROVISION, expected=0)
    (saved,) = tmp_path.glob("n1-*.tgz")
    rig.run("restore", "n1", str(saved), "--yes", expected=0)
    assert rig.powers()["n1"] != rig.powers()["n-base"]
    text = rig.inventory.read_text()
    spare = "  n1: {groups: [north]}\n  n2: {groups: [north], state: spare, label: S2}\n"
    rig.inventory.write_text(text.replace("  n[1-2]: {groups: [north]}\n", spare))
    assert "n1 still answers" in rig.run("replace", "n1", "n2", "--yes").err
    rig.uplinks["north"].cut()
    assert "cannot determine whether n1 is off" in rig.run("replace", "n1", "n2", "--yes").err
    rig.uplinks["north"].mend()
    rig.run("lab", "break", "n1", "off", expected=0)
    assert rig.run("replace", "n1", "n2", "--yes", "--json", expected=0).results == {"n1": "done"}
    assert "n1: {groups: [north], label: S2}" in rig.inventory.read_text()
    rig.run("provision", "--check", expected=0)
