"""Topics and keys changed on running daemons: the inventory, the files and the daemons together, nothing restarted
that need not be."""

from __future__ import annotations

import json

import pytest

from meshctl.inventory import load_fleet
from tests.meshctl.device.servers import eventually
from tests.meshctl.robots.fleets import RobotFleet


def _boots(fleet: RobotFleet) -> dict[str, str]:
    return {name: one["status"].get("boot", "") for name, one in fleet.status().items()}


def _all_online(fleet: RobotFleet) -> bool:
    return all(len(one["online"]) == len(fleet.machines) - 1 for one in fleet.status().values())


def _pair(fleet: RobotFleet) -> dict[str, str]:
    """Two robots that see each other; the names of their processes' lives."""
    for name in ("husky1", "husky2"):
        fleet.add(name)
    fleet.write()
    fleet.deploy()
    eventually(lambda: _all_online(fleet))
    return _boots(fleet)


def test_topics_are_added_set_and_removed_everywhere_without_a_restart(fleet: RobotFleet) -> None:
    boots = _pair(fleet)
    output = fleet.meshctl("topic", "add", "video", "priority=9", "reliable=false", "destinations=[husky1]")
    assert "+  video:" in output
    assert "2 done" in output
    fleet.meshctl("topic", "set", "video", "priority=12")
    for name in fleet.machines:
        here = json.loads(fleet.shell(name, "/opt/udp-mesh/current/bin/udp-mesh topics --json"))
        (video,) = (topic for topic in here["topics"] if topic["name"] == "video")
        assert (video["priority"], video["reliable"], video["destinations"]) == (12, False, ["husky1"])
    assert "2 unchanged" in fleet.deploy()
    fleet.meshctl("topic", "rm", "video")
    assert all(topic["name"] != "video" for one in fleet.status().values() for topic in one["topics"])
    assert _boots(fleet) == boots
    text = fleet.file.read_text()
    assert "there is no topic 'video'" in str(fleet.refused("topic", "set", "video", "priority=3"))
    assert "priority" in str(fleet.refused("topic", "add", "other", "priority=99"))
    assert fleet.file.read_text() == text


def test_a_deploy_restarts_a_daemon_for_what_a_reload_cannot_change(fleet: RobotFleet) -> None:
    fleet.add("husky1")
    fleet.write()
    fleet.deploy()
    (boot,) = _boots(fleet).values()
    fleet.file.write_text(fleet.file.read_text().replace("  heartbeat_s:", "  port: 8710\n  heartbeat_s:"))
    assert "husky1: done: runs " in fleet.deploy()
    (link,) = json.loads(fleet.shell("husky1", "/opt/udp-mesh/current/bin/udp-mesh status --json"))["links"]
    assert link["address"].endswith(":8710")
    assert _boots(fleet) != {"husky1": boot}


def test_a_new_port_is_refused_where_peers_would_get_it_later(
    fleet: RobotFleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    boots = _pair(fleet)
    text = fleet.file.read_text().replace("parallel: 8", "parallel: 1")
    fleet.file.write_text(text.replace("  heartbeat_s:", "  port: 8710\n  heartbeat_s:"))
    output = fleet.deploy(exit_code=1)
    assert "husky1: refused: its port changes from 8700 to 8710, and husky2, which it hears, would change" in output
    assert "husky2: refused: " in output
    assert "MESHCTL_PARALLEL=2 meshctl robots deploy" in output
    assert "refused: its port changes" in fleet.deploy("husky1", exit_code=1)
    assert _boots(fleet) == boots
    monkeypatch.setenv("MESHCTL_PARALLEL", "2")
    assert "2 done" in fleet.deploy()
    eventually(lambda: _all_online(fleet))


def test_a_dry_run_shows_the_change_without_applying_it(fleet: RobotFleet) -> None:
    boots = _pair(fleet)
    fleet.meshctl("topic", "set", "status", "priority=6")
    text = fleet.file.read_text()
    releases = {name: fleet.shell(name, "readlink /opt/udp-mesh/current") for name in fleet.machines}

    output = fleet.meshctl("topic", "add", "video", "priority=9", "--dry-run")
    assert "+  video:" in output
    assert "husky1: " in output
    differences = json.loads(fleet.meshctl("topic", "rm", "status", "--dry-run", "--json"))
    assert {one["result"] for one in differences.values()} == {"pending"}
    assert all(one["differences"] for one in differences.values())
    output = fleet.meshctl("rotate-key", "file:keys.yaml#new", "--dry-run")
    assert "step 3 of 3: drop the old key" in output
    assert "+" in output.split("the first step would change:")[1]

    assert "would restart the service, which is active" in fleet.meshctl("restart", "--dry-run")
    assert "husky2: would stop the service, which is active" in fleet.meshctl("stop", "husky2", "--dry-run")
    assert "would switch from release" in fleet.meshctl("rollback", "--dry-run")
    assert "would remove release" in fleet.meshctl("uninstall", "husky1", "--purge", "--dry-run")

    assert fleet.file.read_text() == text
    assert {name: fleet.shell(name, "readlink /opt/udp-mesh/current") for name in fleet.machines} == releases
    assert _boots(fleet) == boots


def test_a_dry_run_names_the_robots_that_would_refuse(fleet: RobotFleet) -> None:
    fleet.add("husky1")
    fleet.write()
    assert "husky1: udp_mesh is not installed" in fleet.meshctl("restart", "--dry-run", exit_code=1)
    fleet.deploy()
    assert "husky1: there is no previous release" in fleet.meshctl("rollback", "--dry-run", exit_code=1)
    trusted = fleet.directory / "known_hosts"
    pins = trusted.read_text()
    trusted.write_text("")
    assert "would be pinned" in fleet.meshctl("trust", "--dry-run")
    assert trusted.read_text() == ""
    trusted.write_text(pins)
    fleet.machines["husky1"].stop()
    assert "husky1: " in fleet.meshctl("stop", "--dry-run", exit_code=3)


def test_key_rotation_restarts_nothing_and_waits_for_unreachable_robots(fleet: RobotFleet) -> None:
    boots = _pair(fleet)
    fleet.machines["husky2"].stop()
    # a peer that disappears only after a change has begun lets the change be rolled back
    eventually(lambda: fleet.status()["husky1"]["online"] == [])
    output = fleet.meshctl("rotate-key", "file:keys.yaml#new", exit_code=3)
    assert "husky2 did not complete this one" in output
    assert "run `meshctl robots rotate-key file:keys.yaml#new` for the unfinished robots" in output
    assert [key.key for key in load_fleet(fleet.file).udp_mesh.keys] == ["old", "new"]

    fleet.machines["husky2"].start()
    fleet.meshctl("restart", "husky2")
    boots["husky2"] = _boots(fleet)["husky2"]
    eventually(lambda: _all_online(fleet))
    output = fleet.meshctl("rotate-key", "file:keys.yaml#new")
    assert "drop the old key" in output
    assert [key.key for key in load_fleet(fleet.file).udp_mesh.keys] == ["new"]
    eventually(lambda: _all_online(fleet))
    assert _boots(fleet) == boots
    keys = {tuple(one["status"]["keys"]) for one in fleet.status().values()}
    assert len(keys) == 1
    assert len(keys.pop()) == 1
