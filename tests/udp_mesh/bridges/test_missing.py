"""A bridge without its middleware reports what is missing and what to do."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.parametrize(
    ("module", "needs", "remedy"),
    [
        ("ros1", "rosgraph", "source /opt/ros/RELEASE/setup.bash first"),
        ("ros2", "rclpy", "source /opt/ros/RELEASE/setup.bash first"),
        ("zenoh_bridge", "zenoh", "pip install eclipse-zenoh"),
    ],
)
def test_a_missing_middleware_is_reported_in_one_line(tmp_path: Path, module: str, needs: str, remedy: str) -> None:
    (tmp_path / f"{needs}.py").write_text(f"raise ModuleNotFoundError(\"No module named '{needs}'\")\n")
    done = subprocess.run(
        [sys.executable, "-m", f"udp_mesh.bridges.{module}"],
        env={**os.environ, "PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr == f"udp_mesh.bridges.{module}: No module named '{needs}' ({remedy})\n"
