"""Who we are, to a journal and to the locks on nodes, and whether somebody who wrote there still runs.

A process is `host:pid:start`; `start` tells it from a later one with the same pid.
"""

from __future__ import annotations

import getpass
import os
import re
import socket
from pathlib import Path


def owner() -> str:
    """`user@host`: who holds a lock or began a run."""
    try:
        user = getpass.getuser()
    except (KeyError, OSError):
        user = str(os.getuid())
    return f"{user}@{socket.gethostname()}"


def lock_owner() -> str:
    """Names this process to the locks on nodes: `user@host:pid:start`, with nothing but letters, digits and @._:+-."""
    return re.sub(r"[^A-Za-z0-9@._:+-]", "-", f"{owner().partition('@')[0]}@{this_process()}")


def is_dead(lock: str) -> bool:
    """Whether a lock's owner was a process of this machine that has ended: nobody will ever give it back."""
    return bool(lock) and not process_lives(lock.partition("@")[2])


def this_process() -> str:
    """`host:pid:start`, where start tells a process from a later one with the same pid."""
    return f"{socket.gethostname()}:{os.getpid()}:{_start_ticks(os.getpid())}"


def process_lives(process: str) -> bool:
    """Whether the process that wrote a run still runs; one on another host counts as alive, we cannot know."""
    host, _, rest = process.rpartition(":")
    host, _, pid = host.rpartition(":")
    return host != socket.gethostname() or (pid.isdigit() and _start_ticks(int(pid)) == rest)


def _start_ticks(pid: int) -> str:
    """Field 22 of /proc/PID/stat (proc(5)), empty for a process that is not there."""
    try:
        text = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return ""
    return text.rpartition(")")[2].split()[19]
