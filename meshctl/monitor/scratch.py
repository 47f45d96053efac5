"""A directory for temporary files that is removed at the end, also of an interrupted or terminated process; what a
killed one left there is removed by the next.

A directory is locked while its process lives, so that one in use is never removed; a file in it says whose it is,
so that only those of meshctl are removed.
"""

from __future__ import annotations

import fcntl
import os
import shutil
import signal
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType

PREFIX = ".meshctl-"
MARK = "temporary-files-of-meshctl"


class _TerminatedError(BaseException):
    """SIGTERM or SIGHUP, on its way through the code that cleans up."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


@contextmanager
def scratch_directory(parent: Path | None = None) -> Iterator[Path]:
    """A new directory in `parent` (default: that of temporary files). Raises OSError if it cannot be created.

    SIGTERM and SIGHUP end the process after the directory is removed.
    """
    parent = Path(tempfile.gettempdir()) if parent is None else parent
    remove_leftovers(parent)
    with _terminated_after_cleanup():
        made: tuple[Path, int] | None = None
        try:
            # a signal between the two would leave it
            with _signals_delayed():
                made = _created(parent)
            yield made[0]
        finally:
            if made is not None:
                # a second Ctrl-C would leave the rest of it
                with _signals_delayed():
                    shutil.rmtree(made[0], ignore_errors=True)
                    os.close(made[1])


def remove_leftovers(parent: Path) -> None:
    """Remove what killed processes left in `parent`."""
    try:
        found = [Path(entry.path) for entry in os.scandir(parent) if entry.name.startswith(PREFIX)]
    except OSError:
        return
    for directory in found:
        lock = _locked(directory)
        if lock is None:
            continue
        try:
            if (directory / MARK).is_file():
                shutil.rmtree(directory, ignore_errors=True)
            else:
                # killed before it wrote the mark, or of another program: one with contents stays
                with suppress(OSError):
                    directory.rmdir()
        finally:
            os.close(lock)


def _created(parent: Path) -> tuple[Path, int]:
    """A new directory and the descriptor that locks it."""
    while True:
        directory = Path(tempfile.mkdtemp(prefix=PREFIX, dir=parent))
        lock = _locked(directory, is_required=False)
        # None: another process took it for a leftover in between
        if lock is not None:
            with suppress(FileNotFoundError):
                (directory / MARK).touch()
                return directory, lock
            os.close(lock)


def _locked(directory: Path, *, is_required: bool = True) -> int | None:
    """The descriptor that locks a directory of this user; None if another process has it, or if it is gone. A file
    system without locks counts as locked by another, unless the lock is not required."""
    try:
        descriptor = os.open(directory, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
    except OSError:
        return None
    try:
        opened = os.fstat(descriptor)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise
        except OSError:
            if is_required:
                raise
        # removed, or another one of that name, since it was opened
        if opened.st_uid == os.geteuid() and os.path.samestat(opened, os.stat(directory, follow_symlinks=False)):
            return descriptor
    except OSError:
        pass
    os.close(descriptor)
    return None


@contextmanager
def _terminated_after_cleanup() -> Iterator[None]:
    def terminate(number: int, _: FrameType | None) -> None:
        raise _TerminatedError(number)

    replaced: list[signal.Signals] = []
    if threading.current_thread() is threading.main_thread():
        for number in (signal.SIGTERM, signal.SIGHUP):
            # one that is ignored, or has a handler, stays with it
            if signal.getsignal(number) is signal.SIG_DFL:
                signal.signal(number, terminate)
                replaced.append(number)
    try:
        yield
    except _TerminatedError as error:
        signal.signal(error.number, signal.SIG_DFL)
        os.kill(os.getpid(), error.number)
        raise
    finally:
        for each in replaced:
            signal.signal(each, signal.SIG_DFL)


@contextmanager
def _signals_delayed() -> Iterator[None]:
    """SIGINT, SIGTERM and SIGHUP arrive afterwards."""
    numbers = {signal.SIGINT, signal.SIGTERM, signal.SIGHUP}
    before = signal.pthread_sigmask(signal.SIG_BLOCK, numbers)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
