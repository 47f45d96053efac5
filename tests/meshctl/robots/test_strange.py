"""Computers as robotics teams have them: talkative, half deleted, forbidden, mounted oddly. Each is served, or refused
with its reason, and never left between two releases."""

from __future__ import annotations

import getpass

import pytest

from tests.meshctl.robots.fleets import USER_PASSWORD, RobotFleet, give_user

_HALF_DELETED = (
    "rm -r /opt/udp-mesh/trees",
    "rm /opt/udp-mesh/current/manifest",
    "rm -r /opt/udp-mesh/current/etc",
    "rm /opt/udp-mesh/current",
    "rm -r /opt/udp-mesh/releases",
    "rm /etc/systemd/system/udp-mesh.service && systemctl daemon-reload",
    "systemctl stop udp-mesh && userdel udp-mesh",
)
_GREETING = """\
echo 'ROS_MASTER_URI=http://husky1:11311'
echo current=husky
echo free
echo placed
echo 'Welcome!' >&2
"""


@pytest.mark.proof
def test_one_deploy_repairs_a_half_deleted_installation(fleet: RobotFleet) -> None:
    fleet.add("husky1")
    fleet.write()
    fleet.deploy()
    release = fleet.status()["husky1"]["release"]
    for damage in _HALF_DELETED:
        fleet.shell("husky1", damage)
        assert "no changes" not in fleet.meshctl("diff", exit_code=1), damage
        assert f"husky1: done: runs {release}" in fleet.deploy(), damage
        assert "no changes" in fleet.meshctl("diff"), damage
        assert fleet.status()["husky1"]["well"], damage
        assert fleet.shell("husky1", "ls /opt/udp-mesh/releases") == f"{release}\n", damage
    fleet.add_topic("video: {priority: 9}")
    fleet.deploy()
    fleet.shell("husky1", "rm /opt/udp-mesh/previous/topics")
    output = fleet.meshctl("rollback", exit_code=1)
    assert f"the previous release {release} is damaged or missing" in output
    assert fleet.status()["husky1"]["well"]


def test_login_banners_do_not_affect_a_deploy(fleet: RobotFleet, monkeypatch: pytest.MonkeyPatch) -> None:
    key = fleet.key.with_suffix(".pub").read_text()
    for name, rule in (("husky1", "NOPASSWD: ALL"), ("husky2", "ALL")):
        machine = fleet.add(name, start=False)
        give_user(machine, key, rule, home="/home/robot", shell="/bin/bash")
        machine.write("/home/robot/.bashrc", _GREETING)
        machine.write("/root/.bashrc", _GREETING)
        machine.append("/etc/sudoers", "Defaults lecture=always\n")
        # its own name does not resolve, which sudo says on every call
        machine.write("/etc/hosts", "127.0.0.1 localhost\n")
        machine.write("/etc/motd", "current=motd\n")
        machine.start()
        fleet.shell(name, "mount --bind /home /home && mount -o remount,bind,noexec /home")
        fleet.shell(name, "mount -t tmpfs -o size=4k tmpfs /tmp && ! head -c 1M /dev/zero >/tmp/full")
    fleet.write(user="robot")
    output = fleet.deploy(exit_code=1)
    assert "husky1: done: runs " in output
    assert "husky2 (10.42.0.11): sudo requires a password for robot" in output
    monkeypatch.setenv("MESHCTL_SUDO_PASSWORD", "wrong")
    assert "sudo does not let robot become root" in fleet.deploy("husky2", exit_code=1)
    monkeypatch.setenv("MESHCTL_SUDO_PASSWORD", USER_PASSWORD)
    assert "husky2: done: runs " in fleet.deploy("husky2")
    assert "2 unchanged" in fleet.deploy()
    assert all(one["well"] for one in fleet.status().values())
    fleet.write(user="root")
    assert "2 unchanged" in fleet.deploy()
    assert "husky1: done: removed" in fleet.meshctl("uninstall", "husky1")


def test_masked_units_are_refused_and_stay_masked(fleet: RobotFleet) -> None:
    fleet.add("husky1")
    fleet.write()
    fleet.deploy()
    fleet.add_topic("video: {priority: 9}")
    before = fleet.status()["husky1"]["release"]
    fleet.shell("husky1", "systemctl stop udp-mesh && ln -sf /dev/null /etc/systemd/system/udp-mesh.service")
    fleet.shell("husky1", "systemctl daemon-reload")
    output = fleet.deploy(exit_code=1)
    assert "husky1: refused: masked units: udp-mesh.service" in output
    assert "systemctl unmask udp-mesh.service" in output
    assert "masked unit: udp-mesh.service" in fleet.meshctl("restart", exit_code=1)
    assert fleet.shell("husky1", "systemctl is-enabled udp-mesh || :") == "masked\n"
    fleet.shell("husky1", "systemctl unmask udp-mesh")
    fleet.shell("husky1", "mount --bind /opt /opt && mount -o remount,bind,noexec /opt")
    assert "/opt is mounted noexec" in fleet.deploy(exit_code=1)
    assert fleet.status()["husky1"]["release"] == before
    fleet.shell("husky1", "umount -l /opt")
    assert "husky1: done: runs " in fleet.deploy()
    assert fleet.status()["husky1"]["previous"] == before


def test_an_unresolvable_host_and_a_missing_user_are_reported(
    fleet: RobotFleet,
) -> None:
    fleet.add("husky1")
    fleet.write()
    named = fleet.file.read_text()
    fleet.file.write_text(named.replace("ssh: {user: root,", "ssh: {host: husky1.invalid, user: root,"))
    output = fleet.deploy(exit_code=3)
    assert "husky1.invalid cannot be resolved: set an address in robots.husky1.computer.ssh.host" in output
    fleet.file.write_text(named.replace("ssh: {user: root,", "ssh: {"))
    assert fleet.file.read_text() != named
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("LOGNAME", "alice")
        output = fleet.deploy(exit_code=1)
        assert "login refused for alice; tried: " in output
        assert "the inventory has no user, so your own, alice, was tried: set robots.husky1.computer.ssh.user" in output
        patch.setenv("LOGNAME", "root")
        assert getpass.getuser() == "root"
        assert "husky1: done: runs " in fleet.deploy()
