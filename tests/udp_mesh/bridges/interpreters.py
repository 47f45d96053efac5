"""Other Pythons of the machine a test runs on: older ones, and ROS's."""

from __future__ import annotations

import functools
import os
import shutil
import subprocess
import sys
from pathlib import Path


@functools.cache
def older_interpreters(*minors: int) -> tuple[str, ...]:
    """Each Python 3.8 or later, older than this one (or of these minor versions), on the path or among pyenv's."""
    named = [f"python3.{minor}" for minor in minors or range(8, sys.version_info.minor)]
    found = [path for path in map(shutil.which, named) if path]
    pyenv = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"
    found += [str(path) for name in named for path in sorted(pyenv.glob(f"{name[6:]}.*/bin/python"))]
    # A pyenv shim of a version that is not selected does not start.
    # `-I -S`: without site packages it starts in half the time.
    return tuple(
        path
        for path in found
        if subprocess.run([path, "-I", "-S", "-c", ""], capture_output=True, check=False).returncode == 0
    )


ROS_PYTHON = "/usr/bin/python3"
"""The system's: Debian and Ubuntu have ROS 1 as packages of it (scripts/setup-ros)."""
NEEDS_ROS = "MESHCTL_TESTS_NEED_ROS"


@functools.cache
def has_ros() -> bool:
    """Whether the system's Python has a ROS 1 with a master."""
    if not Path(ROS_PYTHON).exists():
        return False
    asked = [ROS_PYTHON, "-c", "import rospy, rosmaster, std_msgs"]
    return subprocess.run(asked, capture_output=True, check=False).returncode == 0


def expects_ros() -> bool:
    """Whether to run tests with a real ROS 1: if it is installed or required."""
    return has_ros() or bool(os.environ.get(NEEDS_ROS))
