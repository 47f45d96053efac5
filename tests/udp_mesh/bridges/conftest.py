"""The quick case with a real ROS 1 is collected where there is one (scripts/setup-ros); the proofs insist on it. A test
that fails shows the last words of all processes it ran."""

from __future__ import annotations

from collections.abc import Generator

import pytest

from tests.udp_mesh.bridges.bridge_processes import LOG_FOLDERS
from tests.udp_mesh.bridges.interpreters import expects_ros
from tests.udp_mesh.bridges.ros2_processes import expects_ros2

collect_ignore = [] if expects_ros() else ["test_exploration.py", "test_ros1_quick.py", "test_ros1_services.py"]
collect_ignore += [] if expects_ros2() else ["test_ros2.py"]
collect_ignore += [] if expects_ros() and expects_ros2() else ["test_mixed_team.py"]

LAST_WORDS = 3000


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    report = yield
    if report.failed:
        for log in sorted(log for folder in LOG_FOLDERS if folder.is_dir() for log in folder.glob("*.log")):
            report.sections.append((log.name, log.read_text(errors="replace")[-LAST_WORDS:]))
    return report
