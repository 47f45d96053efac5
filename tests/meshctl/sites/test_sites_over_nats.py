"""Permanent workers are reached over a real NATS hub and leaf nodes, whose uplinks are cut.

Each test ends with all nodes as the inventory has them.
"""

from __future__ import annotations

import json
import os
import re
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.meshctl.sites.nats_rig import NatsRig
from tests.meshctl.sites.rig import NORTH, SECRETS, SOUTH, Ended
from tests.waiting import until

pytestmark = [pytest.mark.lab, pytest.mark.xdist_group("nats")]
_EVERY = (*NORTH, *SOUTH)
_PROVISION = ("provision", "--yes", "--json")
_AT_WORK = '"node": "n[12]", "at_s": [0-9.]*, "text": "apply"'


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[NatsRig]:
    with NatsRig(tmp_path_factory.mktemp("nats")) as started:
        yield started


@pytest.fixture
def rig(shared: NatsRig) -> NatsRig:
    for uplink in shared.uplinks.values():
        uplink.mend()
    until(lambda: shared.run("sites", "status").code == 0, "both workers to answer", wait_s=120)
    return shared


def _latest_run(rig: NatsRig) -> int:
    number: int = json.loads(rig.run("history", "--json", expected=0).out)[0]["run"]
    return number


def _reasons(ended: Ended) -> set[str]:
    return {event["outcome"]["reason"] for event in ended.events if event["event"] == "finished"}


def _health(frame: dict[str, Any]) -> dict[str, str]:
    return {node["name"]: node["health"] for node in frame["status"]["nodes"]}


def _without_south(frame: dict[str, Any]) -> dict[str, Any] | None:
    """The frame if south alone is missing in it."""
    return frame if _health(frame) == {**dict.fromkeys(NORTH, "ok"), "s-base": "unreachable"} else None


def _site_alarms(frame: dict[str, Any]) -> list[dict[str, Any]]:
    return [alarm for alarm in frame["status"]["alarms"] if alarm["code"] == "site"]


def test_sites_change_over_nats_and_its_servers_get_no_secret(rig: NatsRig) -> None:
    power_dbm = rig.change_power()
    done = rig.run(*_PROVISION, expected=0)
    assert done.results == dict.fromkeys(_EVERY, "done")
    assert set(rig.powers().values()) == {str(power_dbm)}
    assert json.loads(rig.run("history", "--json", expected=0).out)[0]["state"] == "4 done"
    stored = [path.read_bytes() for path in (rig.directory / "nats").rglob("*") if path.is_file()]
    assert any(b"n-base" in content for content in stored), "the events are in the streams"
    assert not any(secret.encode() in content for content in stored for secret in SECRETS.values())
    status = rig.run("sites", "status", "--nodes", expected=0).out
    assert re.search(r"north  3 ok; meshctl \S+, provision by \S+ .* ago: over", status)


def test_status_and_monitor_see_the_nodes_through_their_workers(rig: NatsRig, monkeypatch: pytest.MonkeyPatch) -> None:
    # without it no node can be reached from here
    monkeypatch.delitem(rig.environment, "MESHCTL_LAB")
    status = json.loads(rig.run("status", "--json", expected=0).out)
    assert status["totals"]["nodes"] == {"ok": 4, "degraded": 0, "unreachable": 0, "off": 0}
    assert all(node["drift"] == [] for node in status["nodes"])
    assert {node["name"]: node["hops"] for node in status["nodes"]}["n1"] == 1
    assert rig.run("status", "n1", "--only", "--json").code == 0
    drawn = json.loads(rig.run("topology", "--json", expected=0).out)
    assert {node["name"]: node["hops"] for node in drawn["nodes"]} == dict(zip(_EVERY, (0, 1, 1, 0), strict=True))
    of_north = json.loads(rig.run("topology", "site:north", "--mesh", "north", "--json", expected=0).out)
    assert {node["name"] for node in of_north["nodes"]} == set(NORTH)
    assert rig.run("topology", "--direct", "--timeout", "1", "--json").code == 3
    ready = json.loads(rig.run("preflight", "--json", expected=0).out)
    assert (ready["go"], ready["verdict"]) == (True, "GO")
    with rig.monitoring() as page:
        until(lambda: _health(page("frame")) == dict.fromkeys(_EVERY, "ok"), "a frame of all sites", wait_s=120)
        assert any(frame["airtime"]["bytes_per_s"] > 0 for frame in page("frames"))
        rig.uplinks["south"].cut()
        seen = until(lambda: _without_south(page("frame")), "the alarm of the site", wait_s=120)
        (alarm,) = _site_alarms(seen)
        no_contact = r"no contact with site south .*: the last known state of its node s-base is \d+ s old"
        assert re.search(no_contact, alarm["text"])
        nodes = {node["name"]: node for node in seen["status"]["nodes"]}
        assert nodes["s-base"]["alarms"][0]["text"].startswith("site south ")
        # what needs a login there says what to do instead
        backup = rig.run("backup", "n1", "--out", str(rig.directory / "backups"))
        assert backup.code == 3
        assert "site north is reached over NATS only" in backup.out
        spare = rig.run("replace", "s-base", "bench", "--at", "127.0.0.1:1", "--yes")
        assert "cannot determine whether s-base is off" in spare.err
        assert "pass --old-is-off" in spare.err
        alive = rig.run("replace", "n1", "bench", "--at", "127.0.0.1:1", "--yes")
        assert "n1 still answers at site north" in alive.err
        rig.uplinks["south"].mend()
        until(lambda: not _site_alarms(page("frame")), "the site to answer again", wait_s=120)


def test_an_order_waits_for_a_site_that_is_offline(rig: NatsRig, tmp_path: Path) -> None:
    file, of_south = tmp_path / "plan.json", tmp_path / "south.json"
    power_dbm = rig.change_power()
    rig.run("plan", "--out", str(file), "--brief", expected=0)
    rig.run("plan", *SOUTH, "--out", str(of_south), "--brief", expected=0)
    rig.uplinks["south"].cut()
    until(lambda: rig.run("plan", "site:south").code, "the site to be offline", wait_s=60)
    assert rig.run("provision", "site:south", "--yes", "--json").results == dict.fromkeys(SOUTH, "unreachable")
    ordered = rig.run("apply", str(file), "--json")
    assert ordered.results == {**dict.fromkeys(NORTH, "done"), **dict.fromkeys(SOUTH, "pending")}
    assert any("site south is offline: the order waits for it until 20" in reason for reason in _reasons(ordered))
    run = _latest_run(rig)
    (waiting_run,) = json.loads(rig.run("sites", "status", "south", "--json").out)[0]["waiting"]
    canceled = rig.run("sites", "cancel", "south", waiting_run, expected=0)
    assert "nothing was changed" in canceled.out
    assert rig.run("sites", "cancel", "south", waiting_run).code == 1
    after = rig.run("resume", str(run), "--yes", "--json")
    assert any("is offline and has not reported" in reason for reason in _reasons(after)), after
    assert (after.code, _latest_run(rig)) == (3, run)
    rig.run("apply", str(of_south), "--json")
    run = _latest_run(rig)
    waiting = rig.run("resume", str(run), "--yes", "--json")
    assert any("the order waits for it" in reason for reason in _reasons(waiting))
    # no second order beside the one that waits
    assert (waiting.code, _latest_run(rig)) == (3, run)
    rig.uplinks["south"].mend()
    until(lambda: list(rig.site_directory("south").glob("runs/*/over.json")), "the end of its run", wait_s=120)
    until(lambda: rig.run("resume", str(run), "--yes").code == 0, "the operator to know", wait_s=60)
    outcomes = json.loads(rig.run("history", str(run), "--json", expected=0).out)["outcomes"]
    assert {outcome["node"]: outcome["result"] for outcome in outcomes} == dict.fromkeys(SOUTH, "done")
    assert set(rig.powers().values()) == {str(power_dbm)}
    # what the site replaced has come with its events
    rolled_back = rig.run("rollback", str(run), "--yes", "--json", expected=0)
    assert rolled_back.results == dict.fromkeys(SOUTH, "done")
    powers = rig.powers()
    assert {name for name, power in powers.items() if power == str(power_dbm)} == set(NORTH)
    rig.run(*_PROVISION, expected=0)
    stored = [path.read_bytes() for path in (rig.directory / "nats").rglob("*") if path.is_file()]
    assert not any(secret.encode() in content for content in stored for secret in SECRETS.values())


def test_events_wait_at_the_site_while_its_uplink_is_cut_and_its_worker_killed(rig: NatsRig) -> None:
    rig.change_power()
    first = rig.start(*_PROVISION)
    first.wait_for(_AT_WORK)
    refused = rig.run("provision", *NORTH, "--yes", "--json")
    assert refused.code == 1
    assert all("is in progress at this site" in reason for reason in _reasons(refused)), refused
    run = rig.started_run("north")
    rig.uplinks["north"].cut()
    rig.stop_worker("north")
    first.wait_for("connecting again, the site continues on its own")
    until(lambda: (run / "over.json").exists(), "the end of the run at the site", wait_s=120)
    rig.start_worker("north")
    until(lambda: (run / "published.json").exists(), "its events in the leaf node", wait_s=60)
    rig.uplinks["north"].mend()
    ended = first.end()
    assert (ended.code, ended.results) == (0, dict.fromkeys(_EVERY, "done"))


def test_a_run_whose_operator_died_is_met_again_from_the_hub_alone(rig: NatsRig) -> None:
    power_dbm = rig.change_power()
    started = rig.start(*_PROVISION)
    started.wait_for(_AT_WORK)
    os.killpg(started.process.pid, signal.SIGKILL)
    started.process.wait()
    for site in SECRETS:
        run = next(path.parent for path in sorted(rig.site_directory(site).glob("runs/*/order.json"), key=_age)[-1:])
        _await_publication(run)
    for site in SECRETS:
        rig.stop_worker(site)
    met = rig.run("resume", "--yes", expected=0)
    assert "is finished: nothing to resume" in met.out
    for site in SECRETS:
        rig.start_worker(site)
    assert set(rig.powers().values()) == {str(power_dbm)}


def _await_publication(run: Path) -> None:
    until(lambda: '"is_over": true' in _text(run / "published.json"), "its end to be published", wait_s=120)


def _age(path: Path) -> float:
    return path.stat().st_mtime


def _text(path: Path) -> str:
    return path.read_text() if path.exists() else ""
