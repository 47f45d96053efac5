"""`udp-mesh hosts`: print the peers as lines of a hosts file, or keep them in one while the daemon runs.

`follow` is a client of the daemon: an event of a peer, or ten seconds -> `peers` -> `merge` -> the file, if its text
changes. When the daemon is gone for longer than a restart takes, or this command ends, the block is removed.
"""

from __future__ import annotations

import argparse
import contextlib
import errno
import fcntl
import math
import os
import shutil
import signal
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from types import FrameType

from udp_mesh.cli.hosts_file import HostEntry, MergedHosts, hosts_of, merge, without_block
from udp_mesh.cli.output import Exit, counted, print_error, print_json, print_text
from udp_mesh.client.mesh_client import MeshClient, MeshError

REFRESH_S = 10.0
"""Interval of queries without an event; it also restores a block that another program has removed."""
RECONNECT_S = 1.0
GONE_S = 10.0
"""A daemon that does not answer for this long is gone; a restart takes a few seconds."""
MAX_FILE_BYTES = 1 << 22


def hosts(arguments: argparse.Namespace) -> int:
    """Prints or writes the entries; see the module's docstring."""
    if arguments.remove is not None:
        return _remove(arguments.remove)
    if arguments.write is not None:
        return _follow(arguments.socket, arguments.write)
    with MeshClient(arguments.socket) as mesh:
        found = _query(mesh)
    if arguments.json:
        print_json({"hosts": [host._asdict() for host in found]})
    else:
        print_text("\n".join(f"{host.address} {host.name}" for host in found))
    return Exit.OK


def _remove(path: Path) -> int:
    try:
        _edit(path, without_block)
    except (OSError, ValueError) as error:
        print_error(f"{path}: {_reason(error)}")
        return Exit.FAILED
    return Exit.OK


def _query(mesh: MeshClient) -> tuple[HostEntry, ...]:
    return hosts_of(mesh.request("peers")["peers"])


def _follow(socket: str, path: Path) -> int:
    """Keeps the block until SIGTERM or SIGINT, then removes it."""
    from udp_mesh.daemon.sd_notify import Notifier

    signal.signal(signal.SIGTERM, _interrupt)
    notifier = Notifier()
    block = HostsBlock(path)
    try:
        lock = _lock(path)
    except OSError as error:
        print_error(f"{path}: {_reason(error)}")
        return Exit.FAILED
    try:
        block.write(())
        notifier.ready("waiting for the daemon")
        answered_s = -math.inf
        is_gone = False
        while True:
            try:
                with MeshClient(socket) as mesh:
                    mesh.request("events")
                    while True:
                        conflicts = block.write(_query(mesh))
                        notifier.alive(_status(block.hosts, conflicts))
                        answered_s, is_gone = time.monotonic(), False
                        mesh.next_frame(REFRESH_S)
            except MeshError as error:
                if not is_gone and time.monotonic() - answered_s > GONE_S:
                    is_gone = True
                    print_error(f"{error}; {path} has no peers until the daemon answers")
                    block.write(())
                    notifier.alive("waiting for the daemon")
            time.sleep(RECONNECT_S)
    except KeyboardInterrupt:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        notifier.stopping()
        return _remove(path)
    except (OSError, ValueError) as error:
        print_error(f"{path}: {_reason(error)}")
        return Exit.FAILED
    finally:
        os.close(lock)


def _lock(path: Path) -> int:
    """A descriptor that keeps others from writing there, until it is closed: two would replace each other's names.
    The lock is on the directory, since each change replaces the file. Raises OSError."""
    folder = os.open(os.path.dirname(os.path.realpath(path)), os.O_RDONLY | os.O_DIRECTORY)
    try:
        fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(folder)
        text = "another `udp-mesh hosts --write` keeps its names there: stop it, or write to another directory"
        raise OSError(errno.EBUSY, text) from None
    return folder


def _interrupt(number: int, frame: FrameType | None) -> None:
    raise KeyboardInterrupt


def _status(written: tuple[HostEntry, ...], conflicts: tuple[HostEntry, ...]) -> str:
    names = ", ".join(host.name for host in conflicts)
    left_out = f"; already defined by another line: {names}" if conflicts else ""
    return f"{counted(len(written), 'peer')}{left_out}"


class HostsBlock:
    """The block in one hosts file; `hosts` are those in it. `merge` makes the file's new text."""

    def __init__(self, path: Path, merge: Callable[[str, Iterable[HostEntry]], MergedHosts] = merge) -> None:
        self.path = path
        self._merge = merge
        self.hosts: tuple[HostEntry, ...] = ()
        self._told: tuple[HostEntry, ...] = ()

    def write(self, hosts: tuple[HostEntry, ...]) -> tuple[HostEntry, ...]:
        """Makes these hosts the block; returns those that another line defines. Raises OSError and ValueError."""
        conflicts: tuple[HostEntry, ...] = ()

        def change(text: str) -> str:
            nonlocal conflicts
            text, conflicts = self._merge(text, hosts)
            return text

        _edit(self.path, change)
        self.hosts = tuple(host for host in hosts if host not in conflicts)
        for host in conflicts:
            if host not in self._told:
                print_error(f"{self.path}: another line defines {host.name}; {host.address} is left out")
        self._told = conflicts
        return conflicts


def _edit(path: Path, change: Callable[[str], str]) -> None:
    """Replaces the file's text, unless `change` returns the same. Starts again if another program has replaced the file
    meanwhile. Raises OSError and ValueError."""
    target = Path(os.path.realpath(path))
    while True:
        with target.open("rb") as file:
            status = os.fstat(file.fileno())
            raw = file.read(MAX_FILE_BYTES + 1)
        if len(raw) > MAX_FILE_BYTES:
            raise ValueError(f"expected at most {MAX_FILE_BYTES} bytes")
        # bytes that are not UTF-8 are kept
        before = raw.decode("utf-8", "surrogateescape")
        after = change(before)
        if after == before or _replace(target, after.encode("utf-8", "surrogateescape"), status):
            return


def _replace(target: Path, content: bytes, before: os.stat_result) -> bool:
    """Replaces the file by one with its mode and extended attributes, in one rename; False if it is no longer the file
    that was `seen`. Raises OSError."""
    temporary = target.with_name(f".{target.name}.udp-mesh")
    with contextlib.suppress(FileNotFoundError):
        temporary.unlink()
    with temporary.open("xb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    try:
        shutil.copystat(target, temporary)
        os.utime(temporary)
        now = target.stat()
        if (now.st_ino, now.st_mtime_ns, now.st_size) != (before.st_ino, before.st_mtime_ns, before.st_size):
            temporary.unlink()
            return False
        temporary.replace(target)
    except OSError as error:
        temporary.unlink()
        if error.errno not in (errno.EBUSY, errno.EXDEV):
            raise
        # a container mounts the file itself, and nothing can be renamed over a mount point
        with target.open("r+b") as file:
            file.write(content)
            file.truncate()
    return True


def _reason(error: Exception) -> str:
    return (error.strerror if isinstance(error, OSError) else None) or str(error)
