"""The wheel carries what an installed meshctl needs, and both commands work from any directory."""

from __future__ import annotations

import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("wheel")
    subprocess.run(
        [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation", "-w", directory, ROOT],
        check=True,
        capture_output=True,
    )
    (made,) = directory.glob("*.whl")
    return made


def run(installed: Path, code: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run in a directory of its own, with the installed files before everything else on the path."""
    return subprocess.run(
        [sys.executable, "-c", f"import sys; sys.path.insert(0, {str(installed)!r})\n{code}", *arguments],
        cwd=installed.parent,
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.fixture(scope="module")
def installed(wheel: Path) -> Path:
    """The wheel's files as pip lays them out; the dependencies come from this environment."""
    place = wheel.parent / "installed"
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(place)
    return place


def test_the_wheel_carries_templates_examples_pages_scripts_and_scenarios(wheel: Path) -> None:
    names = zipfile.ZipFile(wheel).namelist()
    for start in (
        "meshctl/_shipped/templates/batman-adv/",
        "meshctl/_shipped/inventory/subt-final/fleet.yaml",
        "meshctl/_shipped/inventory/starter/fleet.yaml",
        "meshctl/_shipped/inventory/lab/fleet.yaml",
        "meshctl/_shipped/lint/MC",
        "meshctl/device/scripts/",
        "meshctl/monitor/assets/index.html",
        "meshctl/monitor/assets/vendor/uPlot.iife.min.js",
        "meshctl/monitor/prometheus/alerts.yml",
        "meshctl/monitor/prometheus/dashboard.json",
        "meshlab/node_root/",
        "mesh_sweep/command.py",
        "udp_mesh/sim/scenarios/final-run.yaml",
        "udp_mesh/daemon/units/",
        "udp_mesh/bridges/udp_mesh_msgs/msg/Conditions.msg",
        "udp_mesh/bridges/udp_mesh_msgs/package.xml",
    ):
        assert any(name.startswith(start) for name in names), start
    for page in ("meshctl.1", "udp-mesh.1"):
        assert any(name.endswith(f".data/data/share/man/man1/{page}") for name in names), page


def test_meshctl_lints_and_renders_a_shipped_example_from_any_directory(installed: Path, tmp_path: Path) -> None:
    example = installed / "meshctl/_shipped/inventory/subt-final"
    code = "from meshctl.cli.main import main; main(sys.argv[1:])"
    linted = run(installed, code, "lint", str(example))
    assert linted.returncode == 0, linted.stdout + linted.stderr
    listed = run(installed, code, "inventory", "list", "-i", str(example))
    assert "husky1-front" in listed.stdout or "husky" in listed.stdout, listed.stderr
    made = run(installed, code, "init", str(tmp_path / "fleet"))
    assert made.returncode == 0, made.stderr


def test_udp_mesh_runs_a_shipped_scenario_from_any_directory(installed: Path) -> None:
    code = "from udp_mesh.cli.main import main; sys.exit(main(sys.argv[1:]))"
    done = run(installed, code, "sim", "partition-soak", "--duration", "5", "--json")
    assert done.returncode == 0, done.stderr
