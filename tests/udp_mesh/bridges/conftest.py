"""The quick case with a real ROS 1 is collected where there is one (scripts/setup-ros); the proofs insist on it."""

import subprocess
from pathlib import Path

ROS_PYTHON = "/usr/bin/python3"


def has_ros() -> bool:
    if not Path(ROS_PYTHON).exists():
        return False
    asked = [ROS_PYTHON, "-c", "import rospy, rosmaster, std_msgs"]
    return subprocess.run(asked, capture_output=True, check=False).returncode == 0


collect_ignore = [] if has_ros() else ["test_ros1_quick.py"]
