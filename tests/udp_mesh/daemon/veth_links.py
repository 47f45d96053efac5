"""Real daemons in network namespaces of their own, joined by veth pairs.

What uses this runs as a module of its own, as root of a network namespace of its own (`run_as_root`), and raises if
anything is not as it should be.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

from tests.udp_mesh.daemon.processes import RunningDaemon


def run_as_root(module: str, *arguments: str) -> None:
    """Run a module in a network namespace of its own; fails with what it wrote to standard error."""
    # Root needs no user namespace, and some systems forbid them.
    become_root = [] if os.geteuid() == 0 else ["--user", "--map-root-user"]
    command = ["unshare", *become_root, "--net", sys.executable, "-m", module, *arguments]
    done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr


def isolated_daemon(folder: Path, name: str, topics: str, *, top: str = "", more: str = "") -> RunningDaemon:
    """A daemon without links yet; `topics`, `top` and `more` are lines of its configuration. The key is `key`."""
    configuration = f"""
name = "{name}"
key_file = "{folder}/key"
{top}
[topics]
{topics}
{more}
[daemon]
socket = "{folder / name}.sock"
state_directory = "{folder / name}"
"""
    daemon = RunningDaemon(folder, name, configuration)
    daemon.prefix = ["unshare", "--net"]
    return daemon


def ip(daemon: RunningDaemon, words: str) -> None:
    """`ip WORDS` in the daemon's namespace."""
    assert daemon.process is not None
    subprocess.run(["nsenter", "-t", str(daemon.process.pid), "-n", "ip", *words.split()], check=True)


def join(daemons: Mapping[str, RunningDaemon], left: str, right: str, network: str) -> None:
    """A veth pair between two daemons, each end named after the other one. They meet once `connect` is called."""
    one, other = daemons[left].process, daemons[right].process
    assert one is not None
    assert other is not None
    words = f"link add {right} netns {one.pid} type veth peer name {left} netns {other.pid}"
    subprocess.run(["ip", *words.split()], check=True)
    for place, (name, interface) in enumerate(((left, right), (right, left)), 1):
        ip(daemons[name], f"addr add {network}.{place}/24 brd + dev {interface}")
    ip(daemons[left], f"link set {right} up")


def connect(daemons: Mapping[str, RunningDaemon], left: str, right: str, *, up: bool = True) -> None:
    """Set the right one's end of a pair up, or down."""
    ip(daemons[right], f"link set {left} {'up' if up else 'down'}")
