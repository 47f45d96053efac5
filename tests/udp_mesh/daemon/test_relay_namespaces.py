"""Daemons behind relays, each in a network namespace of its own."""

import os
import subprocess
import sys


def test_two_daemons_meet_through_a_relay_and_go_on_through_another_when_it_is_killed() -> None:
    # Root needs no user namespace, and some systems forbid them.
    become_root = [] if os.geteuid() == 0 else ["--user", "--map-root-user"]
    command = ["unshare", *become_root, "--net", sys.executable, "-m", "tests.udp_mesh.daemon.relay_namespaces"]
    done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
