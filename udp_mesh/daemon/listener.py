"""The local socket's file and the connections it accepts.

1. `open` binds the path with its mode and group; nobody may connect before these are right.
2. Each connection goes to `take`. Where the process has no descriptor left, accepting rests for a while, which costs
   nothing and is said once: a loop that tried again at once would be all the daemon does.
3. `LOOK_S` apart the file is looked at: one that was deleted (somebody tidied /run) is made again, since no program
   could connect otherwise until the next start. One that became another daemon's is left alone, also at the end.
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
"""Connections that wait to be accepted: all robot's programs starting at once."""
MAX_ACCEPTS_PER_TURN = 16
"""Connections taken per turn of the loop: their protocols, and refusals, get their turn before the next."""
ACCEPT_RETRY_S = 1.0
"""Until the next attempt after the kernel refused a connection for want of descriptors or memory."""
FILE_CHECK_S = 5.0
"""Between two looks at the socket's file: a stat(2) each."""
LOG_AGAIN_S = 60.0
"""Trouble that stays must not fill the log."""


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
        """Listens. Raises OSError: in use by another daemon, no such directory, no such group, not allowed."""
        self._path.parent.mkdir(parents=True, exist_ok=True)
        if _is_answered(self._path):
            raise OSError(f"another daemon answers at {self._path}")
        if self._path.exists() and not self._path.is_socket():
            what = "a directory" if self._path.is_dir() else "a file"
            raise OSError(f"{self._path}: expected nothing there, or a socket left behind, found {what}")
        self._socket = self._bind()
        self._file = _identity(self._path)
        self._start_accepting()
        self._schedule_check()

    def close(self) -> None:
        """Stops listening; removes the file where it is still ours."""
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
            # bind(2) does not say where.
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
                self._log_error(f"no connection can be accepted: {error.strerror}")
                self._stop_accepting()
                asyncio.get_running_loop().call_later(ACCEPT_RETRY_S, self._start_accepting)
                return
            connection.setblocking(False)
            self._on_connection(connection)

    # The file

    def _schedule_check(self) -> None:
        self._timer = asyncio.get_running_loop().call_later(FILE_CHECK_S, self._check_file)

    def _check_file(self) -> None:
        self._schedule_check()
        found = _identity(self._path)
        if found == self._file:
            return
        if found is not None:
            self._log_error(f"{self._path} has become another program's: nobody reaches this daemon there")
            return
        try:
            fresh = self._bind()
        except OSError as error:
            self._log_error(f"{self._path} is gone and cannot be made again: {error.strerror or error}")
            return
        self._stop_accepting()
        if self._socket is not None:
            self._socket.close()
        self._socket, self._file = fresh, _identity(self._path)
        self._start_accepting()
        log.warning("local-socket-made-again path=%s", self._path)

    def _log_error(self, reason: str) -> None:
        """What is wrong, at most once in `SAY_AGAIN_S`."""
        now = asyncio.get_running_loop().time()
        if reason != self._last_error or now - self._logged_at >= LOG_AGAIN_S:
            log.error("local-socket-trouble reason=%s", reason)
            self._last_error, self._logged_at = reason, now


def _identity(path: Path) -> tuple[int, int] | None:
    """Device and inode of what is there now."""
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_dev, found.st_ino


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
        raise OSError(f"daemon.socket_group: expected a group of this machine, found {name!r}") from error
