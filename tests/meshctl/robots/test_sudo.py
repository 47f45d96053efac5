"""Deploying as a user who is not root: sudo with and without a password, a wrong one, none, and no key there at all."""

from __future__ import annotations

import pytest

from tests.meshctl.robots.fleets import USER_PASSWORD, RobotFleet, give_user


def test_sudo_works_with_or_without_a_password_and_a_wrong_one_is_harmless(
    fleet: RobotFleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    key = fleet.key.with_suffix(".pub").read_text()
    for name, rule in (("husky1", "NOPASSWD: ALL"), ("husky2", "ALL"), ("husky3", ""), ("husky4", "ALL")):
        machine = fleet.add(name, start=False)
        give_user(machine, key if name != "husky4" else "", rule)
        machine.start()
    fleet.write(user="robot")
    output = fleet.deploy(exit_code=1)
    assert "husky1: done: runs " in output
    assert "husky2 (10.42.0.11): sudo requires a password for robot" in output
    assert "husky4: failed" in output
    assert "add your public key to ~robot/.ssh/authorized_keys there" in output
    assert "dropbear" not in output
    monkeypatch.setenv("MESHCTL_SUDO_PASSWORD", "wrong")
    output = fleet.deploy("husky2", "husky3", exit_code=1)
    assert "husky2 (10.42.0.11): sudo does not let robot become root" in output
    assert "husky3 (10.42.0.12): sudo does not let robot become root" in output
    assert fleet.shell("husky2", "ls -A /opt/udp-mesh") == "trees\nwheels\n", "as it was before"
    monkeypatch.setenv("MESHCTL_SUDO_PASSWORD", USER_PASSWORD)
    assert "husky2: done: runs " in fleet.deploy("husky2")
    assert "2 unchanged" in fleet.deploy("husky1", "husky2")
