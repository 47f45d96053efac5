"""The local socket's file and the connections it accepts.

1. `open` binds the path with its mode and group; no client can connect before these are set.
2. Each connection goes to `on_connection`. If the process has no descriptor left, accepting pauses for
   `ACCEPT_RETRY_S`, since retrying at once would be a busy loop. The error is logged once.
3. Every `FILE_CHECK_S` the file is checked: if it was deleted (someone cleaned up /run), it is created again, since no
   client could connect otherwise. If it now belongs to another daemon, it is left alone, on close too.
"""

from __future__ import annotations

import asyncio
import grp
import logging
import os
import socket
from collections.abc import Callable
from pathlib import Path

log = logging.getLogger(__name__)

BACKLOG = 256
"""Connections waiting to be accepted: all programs of a robot starting at once."""
MAX_ACCEPTS_PER_TURN = 16
"""Connections accepted per loop iteration, so that their protocols and refusals run before the next ones."""
ACCEPT_RETRY_S = 1.0
"""Delay before the next attempt after the kernel refused a connection for lack of descriptors or memory."""
FILE_CHECK_S = 5.0
"""Interval between two checks of the socket's file, one stat(2) each."""
LOG_AGAIN_S = 60.0
"""Minimum interval between two log lines with the same error."""


class Listener:
    """One listening Unix socket on the running loop."""

    def __init__(
        self, path: Path, *, mode: int, group: str | None, on_connection: Callable[[socket.socket], None]
    ) -> None:
        self._path = path
        self._mode = mode
        self._group = group
        self._on_connection = on_connection
        self._socket: socket.socket | None = None
        self._file: tuple[int, int] | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._last_error: str | None = None
        self._logged_at = 0.0

    def open(self) -> None:
        """Listens. Raises OSError: in use by another daemon, no such directory or group, permission denied."""
        self._path.parent.mkdir(parents=True, exist_ok=True)
        check_unused(self._path)
        if self._path.exists() and not self._path.is_socket():
            what = "a directory" if self._path.is_dir() else "a file"
            raise OSError(f"{self._path}: expected no file or a stale socket, found {what}")
        self._socket = self._bind()
        self._file = _identity(self._path)
        self._start_accepting()
        self._schedule_check()

    def close(self) -> None:
        """Stops listening; removes the file if it is still this daemon's."""
        if self._timer is not None:
            self._timer.cancel()
        if self._socket is None:
            return
        self._stop_accepting()
        self._socket.close()
        self._socket = None
        if _identity(self._path) == self._file:
            self._path.unlink(missing_ok=True)

    def _bind(self) -> socket.socket:
        listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_CLOEXEC | socket.SOCK_NONBLOCK)
        made = False
        try:
            if self._path.is_socket():
                self._path.unlink()
            mask = os.umask(0o177)
            try:
                listener.bind(str(self._path))
                made = True
            finally:
                os.umask(mask)
            if self._group is not None:
                os.chown(self._path, -1, _group_id(self._group))
            self._path.chmod(self._mode)
            listener.listen(BACKLOG)
        except OSError as error:
            listener.close()
            if made:
                self._path.unlink(missing_ok=True)
            if error.strerror is None:
                raise
            # bind(2) does not report the path.
            raise OSError(error.errno, error.strerror, str(self._path)) from error
        return listener

    # Accepting

    def _start_accepting(self) -> None:
        if self._socket is not None:
            asyncio.get_running_loop().add_reader(self._socket.fileno(), self._accept)

    def _stop_accepting(self) -> None:
        if self._socket is not None:
            asyncio.get_running_loop().remove_reader(self._socket.fileno())

    def _accept(self) -> None:
        for _ in range(MAX_ACCEPTS_PER_TURN):
            assert self._socket is not None
            try:
                connection, _address = self._socket.accept()
            except (BlockingIOError, InterruptedError, ConnectionAbortedError):
                break
            except OSError as error:
                self._log_error(f"cannot accept connections: {error.strerror}")
                self._stop_accepting()
                asyncio.get_running_loop().call_later(ACCEPT_RETRY_S, self._start_accepting)
                return
            connection.setblocking(False)
            self._on_connection(connection)

    # The socket's file

    def _schedule_check(self) -> None:
        self._timer = asyncio.get_running_loop().call_later(FILE_CHECK_S, self._check_file)

    def _check_file(self) -> None:
        self._schedule_check()
        found = _identity(self._path)
        if found == self._file:
            return
        if found is not None:
            self._log_error(f"{self._path} was replaced by another program: clients cannot reach this daemon")
            return
        try:
            fresh = self._bind()
        except OSError as error:
            self._log_error(f"{self._path} was deleted and cannot be created again: {error.strerror or error}")
            return
        self._stop_accepting()
        if self._socket is not None:
            self._socket.close()
        self._socket, self._file = fresh, _identity(self._path)
        self._start_accepting()
        log.warning("local-socket-made-again path=%s", self._path)

    def _log_error(self, reason: str) -> None:
        """Logs an error, the same one at most once per `LOG_AGAIN_S`."""
        now = asyncio.get_running_loop().time()
        if reason != self._last_error or now - self._logged_at >= LOG_AGAIN_S:
            log.error("local-socket-trouble reason=%s", reason)
            self._last_error, self._logged_at = reason, now


def _identity(path: Path) -> tuple[int, int] | None:
    """Device and inode of the file at this path."""
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_dev, found.st_ino


def check_unused(path: Path) -> None:
    """Raises OSError if a daemon listens at this path."""
    if _is_answered(path):
        raise OSError(f"{path}: another daemon is already listening")


def _is_answered(path: Path) -> bool:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.settimeout(1.0)
        try:
            probe.connect(str(path))
        except OSError:
            return False
        return True


def _group_id(name: str) -> int:
    try:
        return grp.getgrnam(name).gr_gid
    except KeyError as error:
        raise OSError(f"daemon.socket_group: no such group: {name!r}") from error
