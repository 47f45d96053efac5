"""The results file of a running sweep: locked, appended line by line, repaired after a crash, sorted at the end."""

from __future__ import annotations

import fcntl
import os
import stat
from collections.abc import Iterable
from pathlib import Path
from types import TracebackType
from typing import Self

from mesh_sweep.errors import CONTINUE, SweepError
from mesh_sweep.results import Identity, Result, StoredResults, decode, encode, encode_all


class ResultsFile:
    """Use as a context manager. `stored` is what was there before; `repaired_bytes` is the length of a torn last line
    that was cut off."""

    def __init__(self, path: Path, identity: Identity) -> None:
        self.path, self.identity = path, identity
        self.stored = StoredResults(identity, (), 0)
        self.repaired_bytes = 0
        self._descriptor = -1

    def __enter__(self) -> Self:
        """Raises SweepError for another sweep's file or one in use, OSError if it cannot be written."""
        self._descriptor = self._open()
        try:
            with self.path.open("rb") as file:
                raw = file.read()
            self.stored = decode(raw, str(self.path), self.identity)
            self.repaired_bytes = len(raw) - self.stored.size
            if self.repaired_bytes:
                os.ftruncate(self._descriptor, self.stored.size)
        except BaseException:
            os.close(self._descriptor)
            raise
        return self

    def _open(self) -> int:
        while True:
            descriptor = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o666)
            try:
                if not stat.S_ISREG(os.fstat(descriptor).st_mode):
                    # a device may never end
                    os.close(descriptor)
                    raise SweepError(f"{self.path}: expected a regular file for the results, found none")
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                # a sweep that ends replaces the file: the lock may be on the old one
                if os.path.samestat(os.fstat(descriptor), os.stat(self.path)):
                    return descriptor
            except FileNotFoundError:
                pass
            except BlockingIOError:
                os.close(descriptor)
                raise SweepError(
                    f"{self.path}: another sweep is writing this file: wait for it, or give another --out"
                ) from None
            os.close(descriptor)

    def append(self, result: Result) -> None:
        """Store one result now, with a single write. Raises SweepError for a full disk."""
        line = encode(self.identity, result)
        try:
            while line:
                line = line[os.write(self._descriptor, line) :]
        except OSError as error:
            raise SweepError(f"{self.path}: {error.strerror}; {CONTINUE}") from error

    def finish(self, results: Iterable[Result]) -> None:
        """Replace the file by all results, sorted; at every moment the old or the new content is there.

        Raises OSError.
        """
        # a link stays, and the file that it names is replaced
        path = self.path.resolve()
        new = path.with_name(f".{path.name}.new")
        try:
            with new.open("wb") as file:
                file.write(encode_all(self.identity, results))
                file.flush()
                os.fsync(file.fileno())
            os.replace(new, path)
        finally:
            new.unlink(missing_ok=True)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        os.close(self._descriptor)
