"""The example inventories render, for radios and for robots."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from meshctl.diagnostics import InvalidInput
from meshctl.inventory import load_fleet
from meshctl.model import Secret, SecretRef
from meshctl.render import daemon_config, daemon_keys, render_fleet
from meshctl.render.compare import placeholder_secret
from meshctl.resources import shipped
from tests.meshctl.render import fleets
from udp_mesh.daemon.configuration import load

EXAMPLES = sorted(path.parent.name for path in shipped("inventory").glob("*/fleet.yaml"))
SECRETS: Callable[[SecretRef], Secret] = placeholder_secret


@pytest.mark.parametrize("name", EXAMPLES)
def test_every_node_of_the_examples_renders_once_an_operator_has_a_key(name: str) -> None:
    fleet = load_fleet(shipped("inventory") / name)
    if not fleet.operators.ssh_keys:
        with pytest.raises(InvalidInput, match="RND003"):
            list(render_fleet(fleet, SECRETS))
        fleet = replace(fleet, operators=replace(fleet.operators, ssh_keys=(fleets.ED25519,)))
    assert [item.node for item in render_fleet(fleet, SECRETS)] == [node.name for node in fleet.managed()]


@pytest.mark.parametrize("name", EXAMPLES)
def test_every_robots_daemon_loads_its_configuration(name: str, tmp_path: Path) -> None:
    fleet = load_fleet(shipped("inventory") / name)
    (tmp_path / "fleet.key").write_bytes(daemon_keys(fleet, SECRETS) or b"")
    for robot in fleet.robots.values():
        if robot.computer is not None:
            path = tmp_path / f"{robot.name}.toml"
            path.write_bytes(daemon_config(fleet, robot.name))
            assert load(path).settings.name == robot.name
