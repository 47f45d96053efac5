"""Daemons with a shared log that meet for five seconds each, in network namespaces of their own."""

import os
import subprocess
import sys


def test_every_artifact_arrives_once_through_a_carrier_that_meets_each_for_five_seconds() -> None:
    # Root needs no user namespace, and some systems forbid them.
    become_root = [] if os.geteuid() == 0 else ["--user", "--map-root-user"]
    command = ["unshare", *become_root, "--net", sys.executable, "-m", "tests.udp_mesh.daemon.log_namespaces"]
    done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
