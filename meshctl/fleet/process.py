"""Names of processes in the journal and in the nodes' locks, and whether such a process is still running.

A process is `host:pid:start`; `start` distinguishes it from a later one with the same pid.
"""

from __future__ import annotations

import getpass
import os
import re
import socket
from pathlib import Path


def owner() -> str:
    """`user@host`: the operator who holds a lock or started a run."""
    try:
        user = getpass.getuser()
    except (KeyError, OSError):
        user = str(os.getuid())
    return f"{user}@{socket.gethostname()}"


def lock_owner() -> str:
    """The name of this process in locks on nodes: `user@host:pid:start`, of letters, digits and @._:+- only."""
    return re.sub(r"[^A-Za-z0-9@._:+-]", "-", f"{owner().partition('@')[0]}@{this_process()}")


def is_dead(lock: str) -> bool:
    """Whether a lock's owner is a process of this machine that has ended, and so cannot release it."""
    return bool(lock) and not is_process_alive(lock.partition("@")[2])


def process_of(pid: int) -> str:
    """`host:pid:start` of a process on this computer."""
    return f"{socket.gethostname()}:{pid}:{_start_ticks(pid)}"


def this_process() -> str:
    """`host:pid:start` of this process."""
    return process_of(os.getpid())


def is_process_alive(process: str) -> bool:
    """Whether a process is still running; one on another host counts as running."""
    name, _, start = process.rpartition(":")
    pid = name.rpartition(":")[2]
    # without a start it had ended before it was named
    return not runs_here(process) or (bool(start) and pid.isdigit() and _start_ticks(int(pid)) == start)


def runs_here(process: str) -> bool:
    """Whether a process is one of this computer's."""
    return process.rpartition(":")[0].rpartition(":")[0] == socket.gethostname()


def _start_ticks(pid: int) -> str:
    """Field 22 of /proc/PID/stat (proc(5)), empty if there is no such process."""
    try:
        text = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return ""
    return text.rpartition(")")[2].split()[19]
