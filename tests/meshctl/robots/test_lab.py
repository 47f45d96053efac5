"""While practicing in a lab, no command reaches the real robots, whose addresses are in the copy of the inventory."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

import pytest

from meshctl.cli.main import main
from meshctl.device.trust import TrustStore
from meshctl.errors import InputError
from meshctl.inventory import load_fleet
from meshctl.model import SshSettings
from meshctl.nodes.connections import ConnectionPool
from meshctl.robots.connection import RobotConnector

INVENTORY = Path(__file__).resolve().parents[3] / "inventory/routed"


def test_in_a_lab_only_computers_with_an_ssh_host_are_reached(tmp_path: Path) -> None:
    fleet = load_fleet(INVENTORY)
    with ConnectionPool(fleet, TrustStore(tmp_path / "known_hosts")) as access:
        with pytest.raises(InputError, match=r"10\.43\.1\.10 may be the real robot's"):
            RobotConnector(fleet, access, lab="/lab").endpoint("rover1")
        assert RobotConnector(fleet, access).endpoint("rover1").host == "10.43.1.10"
        rover = fleet.robots["rover1"]
        assert rover.computer is not None
        bench = replace(rover, computer=replace(rover.computer, ssh=SshSettings(host="127.0.0.9", user="robot")))
        practice = replace(fleet, robots=MappingProxyType({"rover1": bench}))
        assert RobotConnector(practice, access, lab="/lab").endpoint("rover1").host == "127.0.0.9"


def test_a_command_for_robots_that_the_lab_does_not_have_is_refused_before_a_run(tmp_path: Path) -> None:
    """Each robot failed, and the last line advised to resume the run, which could only fail again."""
    fleet = load_fleet(INVENTORY)
    with ConnectionPool(fleet, TrustStore(tmp_path / "known_hosts")) as access:
        connector = RobotConnector(fleet, access, lab="/lab")
        with pytest.raises(
            InputError, match="the inventory's addresses of rover1, rover2 may be those of the real"
        ) as e:
            connector.require_a_computer(["rover1", "rover2"])
        assert e.value.hint.startswith("set robots.rover1.computer.ssh.host to a test machine")
        rover = fleet.robots["rover1"]
        assert rover.computer is not None
        bench = replace(rover, computer=replace(rover.computer, ssh=SshSettings(host="127.0.0.9", user="robot")))
        practice = replace(fleet, robots=MappingProxyType({**fleet.robots, "rover1": bench}))
        replace(connector, fleet=practice).require_a_computer(["rover1", "rover2"])
        RobotConnector(fleet, access).require_a_computer(["rover1"])


def test_robots_commands_obey_the_variable_of_the_lab(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("MESHCTL_LAB", str(tmp_path / "none"))
    with pytest.raises(SystemExit) as ended:
        main(["robots", "status", "-i", str(INVENTORY)])
    assert ended.value.code == 2
    assert "no virtual fleet runs" in capfd.readouterr().err
