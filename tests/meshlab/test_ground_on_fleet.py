"""The radio environment of a running fleet, as shown by its nodes' own tools and logins over the mesh."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from typer.testing import CliRunner

from meshctl.cli.main import build
from meshctl.errors import InputError
from meshctl.placement.ground import NodePosition
from meshctl.placement.path_loss import Wall
from meshlab import placement
from meshlab.fleet import VirtualFleet
from meshlab.propagation import RadioEnvironment, links_of
from meshlab.quality import tq_of
from meshlab.spec import LinkSpec
from meshlab.state import Power
from tests.meshlab.conftest import answers, in_mesh
from tests.processes import killed_on_failure
from tests.waiting import until

# a station that is heard sends several times a second
HEARD_MS = 2000

pytestmark = [pytest.mark.lab, pytest.mark.xdist_group("lab")]

# base, near and far in a row, each 60 m from the next
ROW = RadioEnvironment({"base": NodePosition((0, 0)), "near": NodePosition((60, 0)), "far": NodePosition((120, 0))})


@pytest.fixture
def grounded(mesh: VirtualFleet) -> Iterator[VirtualFleet]:
    """The line of three, and its links as they were afterwards."""
    yield mesh
    placement.set_environment(mesh, RadioEnvironment(links=mesh.spec.links))
    (mesh.directory / "ground.json").unlink()


def neighbors(fleet: VirtualFleet, name: str) -> dict[str, int]:
    """The direct neighbors of a node's batman-adv and their quality (originators that are their own next hop)."""
    macs = {mac_of(fleet, one): one for one in ("base", "near", "far")}
    table = json.loads(fleet.node(name).exec("batctl meshif bat0 originators_json").stdout)
    return {macs[row["orig_address"]]: row["tq"] for row in table if row["orig_address"] == row["neigh_address"]}


def mac_of(fleet: VirtualFleet, name: str) -> str:
    words = fleet.node(name).exec("iw dev mesh0 info").stdout.split()
    return words[words.index("addr") + 1]


def signals(fleet: VirtualFleet, name: str) -> list[int]:
    """The signals of the stations that a node hears now; an entry outlasts its station by a minute."""
    dump = fleet.node(name).exec("iw dev mesh0 station dump").stdout
    found = re.findall(r"inactive time:\s*(\d+) ms.*?signal:\s*(-?\d+)", dump, re.DOTALL)
    return [int(signal) for inactive_ms, signal in found if int(inactive_ms) < HEARD_MS]


def lab(fleet: VirtualFleet, *words: str, status: int = 0) -> str:
    done = CliRunner().invoke(build("lab"), ["lab", *words, "--dir", str(fleet.directory)])
    assert done.exit_code == status, done.output
    return done.output


def test_loss_lowers_tq_in_both_directions_and_one_way_loss_in_one(grounded: VirtualFleet) -> None:
    lab(grounded, "link", "near", "far", "--loss", "30%")
    until(lambda: neighbors(grounded, "near").get("far") == tq_of(0.3, 0.3), "the lossy link at near")
    assert neighbors(grounded, "far")["near"] == tq_of(0.3, 0.3)
    lab(grounded, "link", "near", "far", "--loss", "0", "--tq", "255")
    lab(grounded, "link", "far", "near", "--loss", "50%", "--one-way")
    until(lambda: neighbors(grounded, "far").get("near") == tq_of(0.5, 0.0), "far's worse link to near")
    assert neighbors(grounded, "near")["far"] == tq_of(0.0, 0.5)
    lab(grounded, "mend", "near-far")
    until(lambda: neighbors(grounded, "far").get("near") == 200, "the link as it was")


def test_a_node_that_only_receives_hears_others_but_is_unreachable(grounded: VirtualFleet) -> None:
    lab(grounded, "link", "far", "near", "--loss", "100%", "--one-way")
    until(lambda: in_mesh(grounded) == {"near"}, "the mesh without far")
    assert not answers(grounded.endpoint("10.42.0.3"))
    until(lambda: len(signals(grounded, "near")) == 1, "near to hear the base alone")
    assert len(signals(grounded, "far")) == 1
    assert neighbors(grounded, "far") == {}


def test_moving_a_node_reroutes_it_over_a_neighbor_and_then_out_of_the_mesh(grounded: VirtualFleet) -> None:
    placement.set_environment(grounded, ROW)
    until(lambda: set(neighbors(grounded, "base")) == {"near", "far"}, "three that hear each other")
    (link,) = [link for link in links_of(ROW) if link.ends == {"base", "near"}]
    assert neighbors(grounded, "base")["near"] == link.tq_to("near")
    assert link.signal_at("base") in signals(grounded, "base")
    lab(grounded, "move", "far", "200", "-5")
    until(lambda: set(neighbors(grounded, "base")) == {"near"}, "far to be out of the base's earshot")
    until(lambda: in_mesh(grounded) == {"near", "far"} and answers(grounded.endpoint("10.42.0.3")), "far over near")
    lab(grounded, "move", "far", "900", "0")
    until(lambda: in_mesh(grounded) == {"near"}, "far to lose all its links")
    assert not answers(grounded.endpoint("10.42.0.3"))
    assert placement.current_environment(grounded).positions["far"].at == (900, 0)


def test_a_link_override_survives_a_new_environment_until_it_is_repaired(grounded: VirtualFleet) -> None:
    lab(grounded, "link", "base", "near", "--down")
    placement.set_environment(grounded, ROW)
    until(lambda: set(neighbors(grounded, "base")) == {"far"}, "the base without near")
    lab(grounded, "mend", "base-near")
    until(lambda: set(neighbors(grounded, "base")) == {"near", "far"}, "the link of the ground")


def test_an_environment_is_loaded_and_shown_and_rejected_if_it_is_for_another_fleet(
    grounded: VirtualFleet, tmp_path: Path
) -> None:
    file = tmp_path / "ground.yaml"
    file.write_text("nodes: {base: [0, 0], near: [60, 0], far: [120, 0], other: [0, 9]}\n", encoding="utf-8")
    shown = lab(grounded, "ground", str(file))
    assert "near at 60, 0 m" in shown
    assert "base - near: loss 0%" in shown
    assert "box has no position" in shown
    assert "other" not in shown
    assert json.loads(lab(grounded, "ground", "--json"))["nodes"]["far"] == {"at": [120, 0]}
    file.write_text("nodes: {x: [0, 0]}\n", encoding="utf-8")
    assert "found none" in lab(grounded, "ground", str(file), status=2)
    file.write_text("nodes: {x: 0}\n", encoding="utf-8")
    assert "ground.yaml:1:12: nodes.x: expected" in lab(grounded, "ground", str(file), status=2)


def test_invalid_link_and_move_arguments_are_rejected_with_what_was_expected(grounded: VirtualFleet) -> None:
    assert "expected a share such as 30% or 0.3, found 'much'" in lab(
        grounded, "link", "base", "near", "--loss", "much", status=2
    )
    assert "needs --loss" in lab(grounded, "link", "base", "near", "--one-way", "--down", status=2)
    assert "nothing to change" in lab(grounded, "link", "base", "near", status=2)
    assert "cannot move far: it has no position" in lab(grounded, "move", "far", "0", "0", status=2)
    with pytest.raises(InputError, match="no node named nobody"):
        placement.move(grounded, "nobody", (0, 0))


def test_a_large_environment_is_sent_in_parts(grounded: VirtualFleet) -> None:
    crowd = {f"other{number}": NodePosition((0, number)) for number in range(40)}
    placement.set_environment(grounded, RadioEnvironment({**ROW.positions, **crowd}, (Wall((90, -9), (90, 9)),)))
    until(lambda: set(neighbors(grounded, "base")) == {"near"}, "the wall between near and far")


def test_a_mission_drops_a_beacon_and_the_robot_is_reached_over_it(grounded: VirtualFleet, tmp_path: Path) -> None:
    file = tmp_path / "mission.yaml"
    file.write_text(
        "nodes: {base: [0, 0]}\nduration_s: 40\nstep_s: 1\n"
        "robots: {far: {path: [[0, 10, 0], [10, 90, 0], [30, 180, 0]]}}\n"
        "beacons: {near: {carried_by: far, drop_s: 10}}\n",
        encoding="utf-8",
    )
    lines = lab(grounded, "mission", str(file), "--speed", "40", "--json").splitlines()
    events = [json.loads(line) for line in lines if line.startswith("{")]
    assert {"at_s": 10.0, "event": "dropped", "node": "near", "other": "far", "place_m": [90.0, 0.0]} in events
    assert events[-1] == {"at_s": 40.0, "event": "end", "node": "base"}
    until(lambda: grounded.node("near").power is Power.UP, "the beacon to boot")
    until(lambda: in_mesh(grounded) == {"near", "far"}, "the robot over its beacon")
    assert grounded.node("near").exec("cat /proc/uptime").exit_status == 0
    assert placement.current_environment(grounded).positions["near"].at == (90.0, 0.0)
    until(lambda: set(neighbors(grounded, "base")) == {"near"}, "the robot out of the base's own earshot")


def test_an_interrupted_mission_prints_how_to_continue(grounded: VirtualFleet, tmp_path: Path) -> None:
    file = tmp_path / "mission.yaml"
    file.write_text(
        "nodes: {base: [0, 0], near: [60, 0]}\nduration_s: 600\n"
        "robots: {far: {path: [[0, 100, 0], [1, 90, 0], [600, 100, 0]]}}\n",
        encoding="utf-8",
    )
    words = [sys.executable, "-m", "meshctl", "lab", "mission", str(file), "--dir", str(grounded.directory)]
    with (
        subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as playing,
        killed_on_failure(playing),
    ):
        assert playing.stdout is not None
        assert playing.stdout.readline() == "     1.0 s  far arrives at 90, 0 m\n"
        playing.send_signal(signal.SIGINT)
        _, said = playing.communicate(timeout=60)
    assert playing.returncode == 130
    assert "the fleet stays as it is" in said
    assert f"continue with: meshctl lab mission {file} --from " in said
    assert placement.current_environment(grounded).positions["far"].at[0] < 100


def test_without_an_environment_the_links_of_the_spec_are_used(grounded: VirtualFleet) -> None:
    assert placement.current_environment(grounded).links == grounded.spec.links
    assert LinkSpec("base", "near", tq=240, signal_dbm=-61) in grounded.spec.links
