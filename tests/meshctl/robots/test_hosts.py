"""Names of the mesh on the whole robot: /etc/hosts of a real Debian, kept by a real systemd service."""

from __future__ import annotations

from tests.meshctl.device.servers import eventually
from tests.meshctl.robots.fleets import RobotFleet
from tests.meshctl.robots.test_systemd import MAX_EXPOSURE


def _address_of(fleet: RobotFleet, name: str, *, on: str) -> str:
    """The address to which the C library's resolver on a robot resolves a name; empty if it does not."""
    return fleet.shell(on, f"getent ahostsv4 {name} | awk 'NR == 1 {{ print $1 }}'").strip()


def test_peer_names_resolve_on_a_robot_while_its_daemon_runs(fleet: RobotFleet) -> None:
    for name in ("husky1", "husky2"):
        fleet.add(name)
    fleet.write()
    text = fleet.file.read_text()
    fleet.file.write_text(text.replace("heartbeat_s: 0.2", "heartbeat_s: 0.2\n  etc_hosts: true"))
    before = fleet.shell("husky1", "cat /etc/hosts")
    assert _address_of(fleet, "husky2", on="husky1") == ""
    fleet.deploy()
    husky2 = fleet.machines["husky2"].address
    eventually(lambda: _address_of(fleet, "husky2", on="husky1") == husky2)
    assert fleet.shell("husky1", "cat /etc/hosts").startswith(before)
    assert "husky1: no changes" in fleet.meshctl("diff", "--wheels", str(fleet.wheels))

    exposure = f"systemd-analyze security --no-pager --threshold={MAX_EXPOSURE} udp-mesh-hosts.service"
    fleet.shell("husky1", exposure)

    # a line of the operator's wins, and remains
    fleet.shell("husky1", "echo '10.9.9.9 husky2' >>/etc/hosts && systemctl restart udp-mesh-hosts")
    eventually(lambda: _address_of(fleet, "husky2", on="husky1") == "10.9.9.9")
    assert "another line defines husky2" in fleet.meshctl("logs", "husky1")
    fleet.shell("husky1", "sed -i '/10.9.9.9/d' /etc/hosts")
    eventually(lambda: _address_of(fleet, "husky2", on="husky1") == husky2)

    # killed and not started again, it leaves no names; `systemctl kill` would also kill what removes them (systemd 257)
    main_process = "$(systemctl show -p MainPID --value udp-mesh-hosts)"
    fleet.shell("husky1", f"kill -s KILL {main_process} && systemctl stop udp-mesh-hosts")
    assert fleet.shell("husky1", "cat /etc/hosts") == before
    fleet.shell("husky1", "systemctl start udp-mesh-hosts")

    # killed, the service comes back; with the daemon gone, or uninstalled, nothing of it remains
    fleet.shell("husky1", "systemctl kill -s KILL udp-mesh-hosts")
    eventually(lambda: fleet.shell("husky1", "systemctl is-active udp-mesh-hosts || true").strip() == "active")
    fleet.shell("husky1", "systemctl stop udp-mesh")
    eventually(lambda: _address_of(fleet, "husky2", on="husky1") == "")
    fleet.meshctl("restart", "husky1")
    eventually(lambda: _address_of(fleet, "husky2", on="husky1") == husky2)
    fleet.meshctl("uninstall", "husky1")
    assert fleet.shell("husky1", "cat /etc/hosts") == before

    # without the setting the next deploy removes the service
    fleet.file.write_text(text)
    fleet.deploy("husky2")
    assert fleet.shell("husky2", "ls /etc/systemd/system").count("udp-mesh-hosts") == 0
    assert "udp_mesh" not in fleet.shell("husky2", "cat /etc/hosts")
