"""Deploy over a real OpenSSH server and systemd: install, again, upgrade, failure and the way back, repair, removal."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.meshctl.device.servers import eventually
from tests.meshctl.robots.fleets import RobotFleet
from tests.meshctl.robots.wheels import own_wheel_with

# What a second deploy must leave as it is: every file with its time, and the process.
_EVERYTHING = (
    "find /opt/udp-mesh /etc ! -name .lock -printf '%p %T@ %i\\n' | sort; systemctl show -p MainPID udp-mesh.service"
)


def test_the_first_deploy_installs_and_starts_and_the_second_is_a_no_op(fleet: RobotFleet) -> None:
    fleet.add("husky1", fresh=True)
    fleet.write()
    assert "not installed" in fleet.meshctl("diff", exit_code=1, wheels=True)
    assert "not installed" in fleet.deploy("--dry-run")
    assert "not installed" in fleet.meshctl("diff", exit_code=1, wheels=True)
    assert "husky1: done: runs " in fleet.deploy()
    before = fleet.shell("husky1", _EVERYTHING)
    assert "husky1: unchanged: already runs " in fleet.deploy()
    assert fleet.shell("husky1", _EVERYTHING) == before
    # the wheels given once are kept for later commands
    assert "husky1: no changes" in fleet.meshctl("diff")
    found = fleet.status()["husky1"]
    assert found["well"]
    assert {topic["name"] for topic in found["topics"]} == {"estop", "status"}
    key = fleet.shell("husky1", "stat -L -c '%a %U' /opt/udp-mesh/current/etc/fleet.key")
    assert key.split()[:2] == ["600", "udp-mesh"]


def test_a_failed_upgrade_is_rolled_back_automatically(
    fleet: RobotFleet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fleet.add("husky1")
    fleet.write()
    fleet.deploy()
    first = fleet.status()["husky1"]
    better = own_wheel_with(tmp_path, "__init__.py", '__version__ = "', '__version__ = "9.')
    monkeypatch.setattr("meshctl.robots.wheels.own_wheel", lambda: better)
    assert "husky1: done" in fleet.deploy()
    second = fleet.status()["husky1"]
    assert second["status"]["version"].startswith("9.")
    assert second["previous"] == first["release"]

    broken = own_wheel_with(
        tmp_path,
        "daemon/main.py",
        "    service = Service(",
        '    raise OSError("no such radio")\n    service = Service(',
    )
    monkeypatch.setattr("meshctl.robots.wheels.own_wheel", lambda: broken)
    output = fleet.deploy("--wait", "5", exit_code=1)
    assert "husky1: rolled back: systemd could not start the daemon; the previous release runs again" in output or (
        "husky1: rolled back: the daemon does not run" in output
    )
    assert "no such radio" in output, "the operator sees the daemon's last words"
    third = fleet.status()["husky1"]
    assert third["well"]
    assert third["release"] == second["release"]
    assert third["status"]["version"].startswith("9.")

    assert f"husky1: done: runs {first['release']}" in fleet.meshctl("rollback")
    assert fleet.status()["husky1"]["status"]["version"] == first["status"]["version"]


def test_a_first_release_that_fails_to_start_is_removed(
    fleet: RobotFleet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fleet.add("husky1")
    fleet.write()
    broken = own_wheel_with(tmp_path, "daemon/main.py", "    service = Service(", "    raise OSError\n    Service(")
    monkeypatch.setattr("meshctl.robots.wheels.own_wheel", lambda: broken)
    assert "removed, since there is no previous release" in fleet.deploy("--wait", "3", exit_code=1)
    assert fleet.shell("husky1", "ls /opt/udp-mesh/releases /etc/systemd/system/udp*.service 2>/dev/null || :") == (
        "/opt/udp-mesh/releases:\n"
    )


def test_manual_changes_and_interruptions_are_detected_and_fixed(fleet: RobotFleet) -> None:
    fleet.add("husky1")
    fleet.write()
    fleet.deploy()
    release = fleet.status()["husky1"]["release"]
    fleet.shell("husky1", "echo '# tuned' >>/opt/udp-mesh/current/etc/udp-mesh.toml")
    fleet.shell("husky1", "echo broken >/opt/udp-mesh/current/lib/udp_mesh/daemon/api.py")
    output = fleet.meshctl("diff", exit_code=1)
    assert "changed on the robot: etc/udp-mesh.toml" in output
    assert "changed on the robot: lib/./udp_mesh/daemon/api.py" in output
    assert f"husky1: done: runs {release}" in fleet.deploy()
    assert "no changes" in fleet.meshctl("diff")

    fleet.shell("husky1", "rm /opt/udp-mesh/current/manifest")
    assert "changed on the robot: manifest" in fleet.meshctl("diff", exit_code=1)
    assert f"husky1: done: runs {release}" in fleet.deploy()

    # power was cut in the middle of a switch
    fleet.shell("husky1", f"echo {release} >/opt/udp-mesh/unproven")
    assert not fleet.status()["husky1"]["well"]
    assert f"husky1: done: runs {release}" in fleet.deploy()

    assert "the service is inactive" in fleet.meshctl("stop")
    assert not fleet.status()["husky1"]["well"]
    assert "the service is active" in fleet.meshctl("restart")
    assert "ready name=husky1" in fleet.meshctl("logs", "-n", "20")
    assert "husky1: done: removed" in fleet.meshctl("uninstall", "husky1", "--purge")
    assert fleet.shell("husky1", "ls -d /opt/udp-mesh /var/lib/udp-mesh 2>/dev/null || :") == ""
    fleet.shell("husky1", "! id udp-mesh 2>/dev/null")


_TALK = """\
import time
from udp_mesh.client.mesh_client import MeshClient
with MeshClient() as mesh:
    while True:
        mesh.publish("status", b"here", to="husky1")
        time.sleep(0.1)
"""


@pytest.mark.proof
def test_a_release_whose_topics_stop_flowing_is_rolled_back(
    fleet: RobotFleet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("husky1", "husky2"):
        fleet.add(name)
    fleet.write()
    fleet.deploy()
    fleet.shell("husky2", f"cat >/root/talk.py <<'END'\n{_TALK}END")
    there = "PYTHONPATH=/opt/udp-mesh/current/lib $(cat /opt/udp-mesh/current/python) /root/talk.py"
    fleet.shell("husky2", f"systemd-run --unit talk sh -c 'exec env {there}'")

    def heard() -> int:
        (status,) = (topic for topic in fleet.status()["husky1"]["topics"] if topic["name"] == "status")
        return int(status["received_messages"])

    eventually(lambda: heard() > 0)
    first = fleet.status()["husky1"]["release"]
    deaf = own_wheel_with(tmp_path, "daemon/service.py", "count.received_messages += 1", "count.received_messages += 0")
    monkeypatch.setattr("meshctl.robots.wheels.own_wheel", lambda: deaf)
    output = fleet.deploy("husky1", "--wait", "15", exit_code=1)
    assert "husky1: rolled back: topics flowed before and receive nothing: status" in output
    assert fleet.status()["husky1"]["release"] == first
    eventually(lambda: heard() > 0)
