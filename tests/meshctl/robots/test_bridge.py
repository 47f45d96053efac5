"""The ROS 1 bridge as a unit of its own, with Debian's own rospy and ROS master on the machine."""

from __future__ import annotations

import pytest

from tests.meshctl.device.servers import eventually
from tests.meshctl.robots.fleets import RobotFleet
from tests.meshctl.robots.wheels import own_wheel_with

# What ROS's own file of that name does, as far as it counts here.
_SETUP = "export ROS_DISTRO=noetic ROS_MASTER_URI=http://localhost:11311\n"
_MASTER = """\
[Service]
ExecStart=/usr/bin/rosmaster --core -p 11311
Environment=ROS_LOG_DIR=/run/ros
[Install]
WantedBy=multi-user.target
"""
_NODES = (
    "python3 -c 'from xmlrpc.client import ServerProxy; "
    'print(ServerProxy("http://localhost:11311").getSystemState("/test"))\' 2>/dev/null || :'
)


def _is_registered(fleet: RobotFleet) -> bool:
    return "/husky1/mesh_" in fleet.shell("husky1", _NODES)


def _robot_with_ros(fleet: RobotFleet) -> None:
    machine = fleet.add("husky1", start=False)
    machine.write("/etc/systemd/system/rosmaster.service", _MASTER)
    machine.start()
    fleet.shell("husky1", f"mkdir -p /opt/ros/noetic && echo '{_SETUP}' >/opt/ros/noetic/setup.bash")
    fleet.write(ros="noetic")


def _pid(fleet: RobotFleet) -> str:
    return fleet.shell("husky1", "systemctl show -p MainPID --value udp-mesh-ros1.service").strip()


def test_the_bridge_is_deployed_monitored_and_removed_with_the_daemon(fleet: RobotFleet) -> None:
    _robot_with_ros(fleet)
    fleet.shell("husky1", "mv /opt/ros /opt/sor")
    assert "ROS is not installed: /opt/ros/noetic/setup.bash is missing" in fleet.deploy(exit_code=1)
    fleet.shell("husky1", "mv /opt/sor /opt/ros && systemctl start rosmaster")
    assert "husky1: done: runs " in fleet.deploy()
    eventually(lambda: _is_registered(fleet))
    found = fleet.status()["husky1"]
    assert found["well"]
    assert (found["bridge"]["active"], found["bridge"]["enabled"]) == ("active", "enabled")
    pid = _pid(fleet)
    status = fleet.shell("husky1", f"grep -E '^(Uid|CapBnd|NoNewPrivs):' /proc/{pid}/status")
    assert status.split()[1] == fleet.shell("husky1", "id -u udp-mesh").strip()
    assert "CapBnd:\t0000000000000000" in status

    # a change of topics leaves it alone, and it takes them up
    fleet.meshctl("topic", "add", "video", "priority=9")
    assert _pid(fleet) == pid
    eventually(lambda: "mesh_comm/video" in fleet.shell("husky1", _NODES))

    fleet.shell("husky1", "systemctl stop udp-mesh-ros1")
    assert "the ROS bridge is inactive" in fleet.meshctl("diff", exit_code=1)
    assert not fleet.status()["husky1"]["well"]
    fleet.meshctl("uninstall", "husky1")
    assert fleet.shell("husky1", "ls /etc/systemd/system /opt | grep udp-mesh || :") == ""


@pytest.mark.proof
def test_a_failing_bridge_is_rolled_back_and_an_unwanted_bridge_is_removed(
    fleet: RobotFleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    _robot_with_ros(fleet)
    # before there is a master, it waits for one
    assert "husky1: done: runs " in fleet.deploy()
    assert fleet.status()["husky1"]["well"]
    assert "the service is active, the ROS bridge is active" in fleet.meshctl("restart")
    eventually(lambda: "waiting-for what=master" in fleet.meshctl("logs", "-n", "200"))
    fleet.shell("husky1", "systemctl start rosmaster")
    eventually(lambda: _is_registered(fleet))

    first = fleet.status()["husky1"]["release"]
    broken = own_wheel_with(fleet.directory, "bridges/ros1/bridge.py", "import rosgraph\n", "import rosgraf\n")
    with monkeypatch.context() as patch:
        patch.setattr("meshctl.robots.wheels.own_wheel", lambda: broken)
        output = fleet.deploy("--wait", "12", exit_code=1)
    assert "husky1: rolled back: the ROS bridge does not run: systemd says" in output
    assert "No module named 'rosgraf'" in output
    found = fleet.status()["husky1"]
    assert (found["release"], found["well"]) == (first, True)

    assert "the service is inactive, the ROS bridge is inactive" in fleet.meshctl("stop")
    fleet.write()
    assert "differs from the inventory: udp-mesh-ros1.service" in fleet.meshctl("diff", exit_code=1)
    fleet.deploy()
    assert fleet.shell("husky1", "ls /etc/systemd/system | grep udp-mesh; id -u udp-mesh >/dev/null") == (
        "udp-mesh.service\n"
    ), "the inventory says no ROS any more"
    fleet.meshctl("rollback")
    assert fleet.status()["husky1"]["bridge"]["active"] == "active"
