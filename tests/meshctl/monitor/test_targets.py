"""Targets for Prometheus' file_sd_configs, without a Prometheus."""

from __future__ import annotations

import json
from dataclasses import replace
from ipaddress import ip_interface
from pathlib import Path

import pytest

from meshctl.model import Fleet
from meshctl.model.fleet import Computer
from meshctl.monitor.prometheus import daemon_targets, file_sd
from tests.meshctl.status.fleets import trio


@pytest.fixture
def fleet(tmp_path: Path) -> Fleet:
    """Of a base station, 10.42.0.11, and the robots rover, 10.42.0.14, and shelf, 10.42.0.15."""
    plain = trio(tmp_path)
    return replace(plain, udp_mesh=replace(plain.udp_mesh, metrics_port=9871))


def moved(fleet: Fleet, robot: str, address: str | None) -> Fleet:
    """With another address of this robot's computer, or without a computer."""
    computer = None if address is None else Computer(ip_interface(address))
    return replace(fleet, robots={**fleet.robots, robot: replace(fleet.robots[robot], computer=computer)})


def test_each_robots_daemon_is_a_target_on_loopback(fleet: Fleet) -> None:
    assert json.loads(file_sd(fleet)) == [
        {"targets": ["127.0.0.1:9871"], "labels": {"fleet": "trio", "robot": "station", "instance": "station"}},
        {"targets": ["127.42.0.14:9871"], "labels": {"fleet": "trio", "robot": "rover", "instance": "rover"}},
        {"targets": ["127.42.0.15:9871"], "labels": {"fleet": "trio", "robot": "shelf", "instance": "shelf"}},
    ]


def test_daemons_without_metrics_are_no_targets(fleet: Fleet) -> None:
    silent = replace(fleet, udp_mesh=replace(fleet.udp_mesh, metrics_port=None))
    assert json.loads(file_sd(silent)) == []
    assert daemon_targets(silent) == ({}, ())


def test_a_robot_without_a_daemon_is_no_target_and_moves_no_other(fleet: Fleet) -> None:
    targets, problems = daemon_targets(moved(fleet, "rover", None))
    assert targets == {"station": "127.0.0.1:9871", "shelf": "127.42.0.15:9871"}
    assert list(problems) == []


@pytest.mark.parametrize(
    ("address", "problem"),
    [
        ("fd00::14/64", "rover is no target: its address fd00::14 is IPv6, which has one loopback address"),
        # a target may come once, or its metrics would have the labels of two robots
        ("172.0.0.1/24", "rover is no target: 127.0.0.1:9871 is that of station"),
    ],
)
def test_a_robot_that_has_no_loopback_address_of_its_own_is_named(fleet: Fleet, address: str, problem: str) -> None:
    targets, problems = daemon_targets(moved(fleet, "rover", address))
    assert list(targets) == ["station", "shelf"]
    assert list(problems) == [problem]


def test_the_base_station_may_have_an_ipv6_address(fleet: Fleet) -> None:
    targets, problems = daemon_targets(moved(fleet, "station", "fd00::11/64"))
    assert targets["station"] == "127.0.0.1:9871"
    assert list(problems) == []
