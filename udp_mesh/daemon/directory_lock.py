"""One process at a time uses a directory of stored messages (flock(2) on the directory itself).

Two of them would send each message twice and delete each other's files. The kernel releases the lock however the
process ends.
"""

from __future__ import annotations

import fcntl
import logging
import os
from pathlib import Path

log = logging.getLogger(__name__)


class DirectoryLock:
    """Locks the directory, which is created if it does not exist, until `release`.

    Raises OSError if another process, or another lock of this one, holds it. A directory that cannot be created or
    read, or is on a file system without locks, is not locked: the daemon starts all the same, as it does without a
    usable disk.
    """

    def __init__(self, directory: Path, *, mode: int = 0o755) -> None:
        self._descriptor: int | None = None
        try:
            directory.mkdir(parents=True, exist_ok=True, mode=mode)
            self._descriptor = os.open(directory, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
            fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self.release()
            raise OSError(f"{directory}: in use by another daemon or program") from None
        except OSError as error:
            self.release()
            log.debug("not-locked directory=%s error=%s", directory, error)

    def release(self) -> None:
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None
