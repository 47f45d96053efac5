"""Deploy over a real OpenSSH server: install, again, upgrade, failure and the way back, refusals in time.

The service runs under a stand-in for systemctl; everything else is real.
"""

from __future__ import annotations

from tests.meshctl.robots.fleets import RobotFleet


def test_a_first_deploy_installs_and_starts_and_a_second_changes_nothing(fleet: RobotFleet) -> None:
    fleet.add("husky1")
    fleet.write()
    assert "husky1: done: runs " in fleet.deploy()
    before = fleet.shell("husky1", "find /opt/udp-mesh -newer /run/sshd | sort; cat /run/stand-in/*.pid")
    assert "husky1: unchanged: already runs " in fleet.deploy()
    assert fleet.shell("husky1", "find /opt/udp-mesh -newer /run/sshd | sort; cat /run/stand-in/*.pid") == before
