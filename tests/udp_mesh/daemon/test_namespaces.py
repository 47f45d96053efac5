"""Daemons follow changes of interfaces and addresses, IPv4 or IPv6, during transfers."""

import os
import subprocess
import sys

import pytest

from tests.udp_mesh.daemon.namespaces import SCENARIOS


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_daemons_follow_interface_and_address_changes(scenario: str) -> None:
    # Root needs no user namespace, and some systems forbid them.
    become_root = [] if os.geteuid() == 0 else ["--user", "--map-root-user"]
    done = subprocess.run(
        ["unshare", *become_root, "--net", sys.executable, "-m", "tests.udp_mesh.daemon.namespaces", scenario],
        check=False,
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode == 0, done.stderr
