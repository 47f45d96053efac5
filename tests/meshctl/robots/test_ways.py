"""Ways to a robot: its packages through pip, and itself through its radio."""

from __future__ import annotations

import pytest

from meshctl.device.trust import TrustStore
from tests.meshctl.robots.fleets import RobotFleet
from tests.meshctl.robots.lan import Lan
from tests.meshctl.robots.machine import Machine


def test_a_robot_behind_its_radio_is_deployed_from_cached_pip_packages(
    fleet: RobotFleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    inner = Lan("10.42.1.1")
    try:
        # the radio stands in both networks and forwards nothing by itself
        radio = Machine(fleet.base, fleet.directory / "radio", fleet.lan, "10.42.0.1", fleet.key)
        inner.connect(radio.network, "10.42.1.2", "eth1")
        fleet.machines["radio"] = radio
        radio.start()
        robot = Machine(fleet.base, fleet.directory / "husky1", inner, "10.42.1.10", fleet.key)
        fleet.machines["husky1"] = robot
        with inner.inside():
            robot.start()
        del fleet.machines["radio"]
        fleet.write(jump="base")
        TrustStore(fleet.directory / "known_hosts").replace("base", radio.host_key)
        assert not robot.answers, "there is no other way to it"

        monkeypatch.setenv("PIP_NO_INDEX", "1")
        monkeypatch.setenv("PIP_FIND_LINKS", str(fleet.directory / "nothing"))
        output = fleet.meshctl("deploy", "--key", str(fleet.key), exit_code=1)
        assert "pip could not download wheels for CPython" in output
        assert "without internet access, pass --wheels DIR" in output
        monkeypatch.setenv("PIP_FIND_LINKS", str(fleet.wheels))
        output = fleet.meshctl("deploy", "--key", str(fleet.key))
        assert "husky1: done: runs " in output
        # in the field there is neither pip nor its index
        monkeypatch.setenv("PIP_FIND_LINKS", str(fleet.directory / "nothing"))
        assert "husky1: unchanged" in fleet.meshctl("deploy", "--key", str(fleet.key))
        refused = fleet.meshctl("trust", "--yes", exit_code=1)
        assert "husky1: base (10.42.0.1): login refused for root; tried: " in refused
        (fleet.directory / "known_hosts").write_text("")
        TrustStore(fleet.directory / "known_hosts").replace("base", radio.host_key)
        assert "pinned now" in fleet.meshctl("trust", "--yes", "--key", str(fleet.key))
        assert "husky1: unchanged" in fleet.meshctl("deploy", "--key", str(fleet.key))
        # the gateway of a site is such a way, too, with a key of its own
        fleet.write(gateway="10.42.0.1")
        unknown = fleet.meshctl("deploy", exit_code=1)
        assert "run `meshctl sites trust field`" in unknown
        TrustStore(fleet.directory / "known_hosts").replace("site.field", radio.host_key)
        assert "husky1: unchanged" in fleet.meshctl("deploy")
        assert fleet.status()["husky1"]["well"]
        fleet.add_topic("position: {priority: 4}")
        assert "husky1: done: runs " in fleet.meshctl("deploy")
    finally:
        fleet.stop()
        radio.stop()
        inner.close()
