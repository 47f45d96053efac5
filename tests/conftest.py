"""Shared set-up of all tests: the hypothesis profiles, and a word of what cannot be tested here.

`fast` (the default) is derandomized, so that a run on a busy machine tests the same cases as any other run and no
deadline depends on the clock. `deep` draws new cases and many more of them: `HYPOTHESIS_PROFILE=deep make test`.
"""

import gc
import os
import signal
from importlib.metadata import version

import pytest
from hypothesis import HealthCheck, settings

from tests.meshctl.cli.speech_program import NEEDS_SPEECH, expects_speech
from tests.meshctl.fleet.postgresql_server import NEEDS_POSTGRESQL, expects_postgresql
from tests.meshctl.monitor.browser import CHROMIUM, NEEDS_BROWSER, expects_browser
from tests.meshctl.monitor.prometheus_program import NEEDS_PROMETHEUS, expects_prometheus
from tests.meshctl.sites.nats_servers import NEEDS_NATS, PROGRAM, expects_nats
from tests.udp_mesh.bridges.interpreters import NEEDS_ROS, ROS_PYTHON, expects_ros
from tests.udp_mesh.bridges.ros2_processes import NEEDS_ROS2, PYTHON, expects_ros2

pytest_plugins = ["tests.fleet_reports"]

settings.register_profile(
    "fast", derandomize=True, deadline=None, max_examples=60, suppress_health_check=[HealthCheck.too_slow]
)
settings.register_profile("deep", deadline=None, max_examples=2000, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "fast"))


# A shell's background job ignores SIGINT, and so would every program that a test interrupts.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# Eight thousand collected tests and their modules stay: the default thresholds search them again and again for cycles.
gc.set_threshold(50_000, 20, 50)

LONGEST_GROUPS = ("lab-real-team", "lab", "fleet", "nats")
"""The groups of tests that share a fleet or a machine and wait for minutes: each begins at once, on its own worker."""
GROUPS_UNTIL = 2 / 3
"""The share of the tests without a group before which all other groups have begun."""

TRIED_AGAIN = "tried again"
"""The property of a test in whose setup a machine was made once more: why."""


NOT_TESTED = (
    (
        expects_ros2,
        f"ROS 2: there is no {PYTHON}, so tests/udp_mesh/bridges/test_ros2.py was not collected. scripts/setup-ros2"
        f" makes it (Python 3.11, x86_64); {NEEDS_ROS2}=1 makes it fail instead.",
    ),
    (
        expects_ros,
        f"ROS 1: {ROS_PYTHON} has no rospy and rosmaster, so tests/udp_mesh/bridges/test_ros1_quick.py was not"
        f" collected. scripts/setup-ros installs them (Debian, Ubuntu); {NEEDS_ROS}=1 makes it fail instead.",
    ),
    (
        expects_browser,
        f"Browser: there is no {CHROMIUM} in PATH, so the tests of the monitor's page were skipped."
        f" scripts/setup-browser installs it (Debian); {NEEDS_BROWSER}=1 makes them fail instead.",
    ),
    (
        expects_prometheus,
        "Prometheus: there is no prometheus in PATH, so tests/meshctl/monitor/test_prometheus.py was not"
        f" collected. scripts/setup-prometheus installs it (Debian, Ubuntu); {NEEDS_PROMETHEUS}=1 makes it fail"
        " instead.",
    ),
    (
        expects_speech,
        "Speech: there is no espeak-ng in PATH, so tests/meshctl/cli/test_voice.py was not collected."
        f" scripts/setup-speech installs it (Debian, Ubuntu); {NEEDS_SPEECH}=1 makes it fail instead.",
    ),
    (
        expects_nats,
        f"NATS: there is no {PROGRAM} in PATH, so the tests of sites over NATS were not collected. scripts/setup-nats"
        f" installs it (Debian, Ubuntu); {NEEDS_NATS}=1 makes them fail instead.",
    ),
    (
        expects_postgresql,
        "PostgreSQL: there is no /usr/lib/postgresql/*/bin/initdb, so the tests of a shared journal were not"
        f" collected. scripts/setup-postgresql installs it (Debian, Ubuntu); {NEEDS_POSTGRESQL}=1 makes them fail"
        " instead.",
    ),
)
"""Programs that tests need: whether their tests are collected, and what to say where they are not."""


def pytest_configure(config: pytest.Config) -> None:
    """Tests that share a fleet or a machine share a worker; a pytest that loses that without a word is refused.

    pytest-xdist writes a test's group behind `_nodeid`, which is not there from pytest 9.2 on: then every worker would
    start a machine of its own.
    """
    if config.getoption("dist", "no") != "loadgroup":
        return
    if not any("_nodeid" in vars(kind).get("__slots__", ()) for kind in pytest.Item.__mro__):
        raise pytest.UsageError(
            f"pytest {pytest.__version__} and pytest-xdist {version('pytest-xdist')} lose the groups of tests:"
            " expected pytest below 9.2, which `make setup` installs"
        )


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the longest groups first, and the others among the tests without a group: pytest-xdist hands them out in this
    order (`--no-loadscope-reorder`).

    The tests of a group mostly wait in real time, those without one compute: beside each other they use the whole
    machine. Tests without a group end the run evenly on all workers.
    """
    groups: dict[str, list[pytest.Item]] = {}
    single: list[pytest.Item] = []
    for item in items:
        mark = item.get_closest_marker("xdist_group")
        (single if mark is None else groups.setdefault(mark.args[0], [])).append(item)
    ordered = [item for name in LONGEST_GROUPS for item in groups.pop(name, ())]
    step = int(len(single) * GROUPS_UNTIL / max(1, len(groups)))
    for number, group in enumerate(groups.values()):
        ordered += [*single[number * step : (number + 1) * step], *group]
    items[:] = [*ordered, *single[len(groups) * step :]]


def pytest_collection_finish() -> None:
    """What was collected stays to the end, so that nothing has to look for garbage in it."""
    gc.collect()
    gc.freeze()


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Nothing is left out or tried again without a word."""
    reports = [report for reports in terminalreporter.stats.values() for report in reports]
    properties = [each for report in reports for each in getattr(report, "user_properties", ())]
    reasons = dict.fromkeys(str(reason) for name, reason in properties if name == TRIED_AGAIN)
    if reasons:
        terminalreporter.section("tried again")
        for reason in reasons:
            terminalreporter.line(reason)
    absent = [text for expects, text in NOT_TESTED if not expects()]
    if absent:
        terminalreporter.section("not tested here")
        for text in absent:
            terminalreporter.line(text)
