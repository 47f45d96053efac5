"""Radio environments of the kernel's radios: losses, positions and a mission, as seen by the kernel's batman-adv."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.meshlab.qemu.conftest import Lab, until

pytestmark = [pytest.mark.proof, pytest.mark.lab, pytest.mark.xdist_group("lab-real"), pytest.mark.timeout(1800)]

# 80 m are heard, 160 m are not
AIR = "air: {tx_power_dbm: 33, exponent: 4.4}\n"
ROW = AIR + "nodes: {base: [0, 0], b01: [80, 0], b02: [160, 0], husky-front: [230, 0], husky-rear: [230, 5]}\n"
DRIVE = (
    AIR + "nodes: {base: [0, 0], b01: [80, 0]}\nduration_s: 40\nrobots:\n"
    "  husky-front: {path: [[0, 100, 0], [30, 230, 0]]}\n"
    "  husky-rear: {path: [[0, 100, 5], [30, 230, 5]]}\n"
    "beacons:\n  b02: {carried_by: husky-front, drop_s: 14}\n"
)


@pytest.fixture
def field(lab: Lab, tmp_path: Path) -> Iterator[Path]:
    """A directory for files; afterwards the fleet's links are restored."""
    yield tmp_path
    lab.meshctl("lab", "mend")
    lab.meshctl("lab", "ground", str(lab.inventory / "links.yaml"))
    lab.settle()


def quality(lab: Lab, node: str, other: str) -> int:
    """The quality of a node's direct link to another one in its batman-adv, 0 if there is none."""
    names = lab.names()
    known = json.loads(lab.on(node, "batctl meshif bat0 originators_json"))
    return max(
        (one["tq"] for one in known if names[one["orig_address"]] == names[one["neigh_address"]] == other), default=0
    )


def written(folder: Path, text: str) -> str:
    file = folder / "ground.yaml"
    file.write_text(text, encoding="utf-8")
    return str(file)


def test_one_way_loss_lowers_the_kernel_tq_in_that_direction_only(lab: Lab, field: Path) -> None:
    until(lambda: min(quality(lab, "b01", "b02"), quality(lab, "b02", "b01")) > 220, "a link without losses")
    lab.meshctl("lab", "link", "b01", "b02", "--loss", "60%", "--one-way")
    # 255 * 0.4 there; back nothing is lost, but b02 hears little of b01: 255 * (1 - 0.6 ** 3)
    until(lambda: 20 < quality(lab, "b01", "b02") < 150, "the loss towards b02")
    until(lambda: quality(lab, "b02", "b01") - quality(lab, "b01", "b02") > 50, "the better way back")


def test_a_robot_that_moves_changes_the_kernel_s_routes(lab: Lab, field: Path) -> None:
    shown = lab.meshctl("lab", "ground", written(field, ROW)).text
    assert "husky-front at 230, 0 m" in shown
    until(lambda: lab.originators("base").get("husky-front") == "b01", "the way over b01")
    lab.meshctl("lab", "move", "husky-front", "40", "-30")
    until(lambda: lab.originators("base").get("husky-front") == "husky-front", "the robot in the base's earshot")
    assert "husky-front" in lab.neighbors("base")
    lab.meshctl("lab", "move", "husky-front", "230", "0")
    until(lambda: "husky-front" not in lab.neighbors("base"), "the robot out of the base's earshot")
    until(lambda: lab.originators("base").get("husky-front") == "b01", "the way over b01 again")


def test_a_mission_drops_a_beacon_and_the_mesh_heals_over_it(lab: Lab, field: Path) -> None:
    events = lab.meshctl("lab", "mission", written(field, DRIVE), "--speed", "2", "--json").events
    assert {"at_s": 14.0, "event": "dropped", "node": "b02", "other": "husky-front"}.items() <= next(
        event for event in events if event["event"] == "dropped"
    ).items()
    assert events[-1]["event"] == "end"
    until(lambda: lab.node("b02").is_up(), "the beacon to boot")
    until(lambda: lab.originators("base").get("husky-front") == "b01", "the robot behind two beacons")
    until(lambda: lab.originators("b01").get("husky-front") == "b02", "the dropped beacon in between")
    until(lambda: lab.answers("base-station", "10.42.0.10"), "the robot's computer to answer")
