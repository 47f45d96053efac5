"""The tutorials of other kinds of fleet: every command of their pages ends with the exit code that the page says."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from meshctl.cli.main import build
from meshctl.inventory import load_fleet

ROOT = Path(__file__).resolve().parents[3]
PAGES = {"community-mesh": "community", "mine": "mine", "uav-swarm": "swarm", "routed-lans": "routed"}


@pytest.mark.parametrize("name", PAGES.values())
def test_the_inventory_of_a_tutorial_has_no_error_and_no_warning(name: str) -> None:
    result = CliRunner().invoke(build("lint"), ["lint", str(ROOT / "inventory" / name)])
    assert (result.exit_code, "note" in result.output) == (0, True), result.output


def test_the_community_has_sixty_houses_on_two_releases() -> None:
    fleet = load_fleet(ROOT / "inventory/community")
    houses = [node for node in fleet.nodes.values() if node is not fleet.base_node]
    assert len(houses) == 60
    assert {node.release.value for node in houses} == {"19.07", "23.05"}
    assert not fleet.robots


@pytest.mark.lab
@pytest.mark.xdist_group("tutorials")
@pytest.mark.parametrize("page", PAGES)
def test_every_command_of_a_tutorial_works(page: str, tmp_path: Path) -> None:
    copy = tmp_path / f"{page}.md"
    shutil.copy(ROOT / f"docs/tutorials/{page}.md", copy)
    without = ("MESH_KEY", "UDP_MESH_KEY", "MESHCTL_CONFIG")
    environ = {name: text for name, text in os.environ.items() if name not in without}
    environ["PATH"] = f"{Path(sys.executable).parent}:{environ['PATH']}"
    done = subprocess.run(
        [sys.executable, str(ROOT / "scripts/run-tutorial"), str(copy)],
        env=environ,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout[-8000:] + done.stderr
