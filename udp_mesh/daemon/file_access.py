"""Reads files named by requests and configurations without ever blocking the daemon.

Only regular files are read: opening a pipe waits for a writer, and a device may do anything. A disk that hangs (a
network file system) blocks a thread of its own, and the request is refused after `FILE_TIMEOUT_S`.
"""

from __future__ import annotations

import asyncio
import errno
import os
import stat
import threading
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

FILE_TIMEOUT_S = 5.0
"""A request that needs a file is refused after this; a healthy disk takes milliseconds."""

_KINDS = (
    (stat.S_ISFIFO, "a pipe"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)

Result = TypeVar("Result")


def read_regular(path: Path, limit_bytes: int) -> bytes:
    """Reads up to `limit_bytes` + 1 bytes of a regular file, following links. Raises OSError for other files."""
    _must_be_regular(path, path.stat().st_mode)
    # The file may be replaced in between: open without blocking, and check the opened file again.
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC)
    with open(descriptor, "rb") as file:
        _must_be_regular(path, os.fstat(descriptor).st_mode)
        return file.read(limit_bytes + 1)


def _must_be_regular(path: Path, mode: int) -> None:
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if not stat.S_ISREG(mode):
        found = next((name for is_kind, name in _KINDS if is_kind(mode)), "something else")
        raise OSError(errno.EINVAL, f"{found}, not a regular file", str(path))


def is_exposed(path: Path) -> bool:
    """Whether every user of this computer may read a file."""
    try:
        return bool(path.stat().st_mode & stat.S_IROTH)
    except OSError:
        return False


async def off_loop(work: Callable[[], Result], *, timeout_s: float = FILE_TIMEOUT_S) -> Result:
    """Runs `work` in a daemon thread, which may outlive the call. Raises TimeoutError, or what `work` raises."""
    loop = asyncio.get_running_loop()
    done: asyncio.Future[Result] = loop.create_future()

    def settle(set_it: Callable[[], None]) -> None:
        if not done.done():
            set_it()

    def run() -> None:
        try:
            result = work()
        except Exception as error:  # noqa: BLE001 - handed over to the caller
            failure = error
            answer: Callable[[], None] = lambda: done.set_exception(failure)  # noqa: E731
        else:
            answer = lambda: done.set_result(result)  # noqa: E731
        try:
            loop.call_soon_threadsafe(settle, answer)
        except RuntimeError:
            # The loop is closed and the result no longer needed.
            return

    threading.Thread(target=run, name="file", daemon=True).start()
    async with asyncio.timeout(timeout_s):
        return await done


def is_below(path: Path, directory: Path) -> bool:
    """Whether a new file at this path would be in or below a directory, with links resolved."""
    try:
        return path.parent.resolve(strict=True).is_relative_to(directory.resolve())
    except OSError:
        return False
