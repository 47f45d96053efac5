"""Messages stored on disk for offline peers: one file per message in one directory.

`put` passes a message to a thread that writes the files in order, each under a temporary name that is then renamed.
Once `flush` returns, everything put before is on disk (fsync of files and directory) and survives a power cut; only
then does the daemon reply to a publisher of such a topic. However slow the disk, no other caller waits for it. `load`
reads the stored messages and renames damaged files. The directory is bounded: beyond `limit_bytes` a message is refused
and counted, so the disk does not fill up.

A file is a line with the message's fields as JSON and the CRC-32 of these and the payload, then the payload.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import os
import tempfile
import threading
import time
import zlib
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

from udp_mesh.core.interfaces import StoredMessage
from udp_mesh.daemon.directory_lock import DirectoryLock

log = logging.getLogger(__name__)

SUFFIX = ".message"
LOG_AGAIN_S = 60.0
"""Minimum interval between two log lines about a full disk."""
REMOVE_AGAIN_S = 5.0
"""Interval between attempts to remove files that a read-only or broken disk kept: a restart would send them again."""
DIRECTORY_MODE = 0o700
_CHECKSUM_BYTES = 8


class DirectoryStore:
    """The core's `Store` over a directory (created with the first message, readable only by its owner).

    Messages waiting to be written are bounded like the directory, since both count from `put` on.
    """

    def __init__(self, directory: Path, limit_bytes: int) -> None:
        self._directory = directory
        self._limit_bytes = limit_bytes
        # Guards what the caller's thread and the writer thread both change.
        self._lock = threading.Lock()
        self._sizes: dict[int, int] = {}
        self._logged_at = float("-inf")
        self.bytes = 0
        """Bytes of all stored files, including those still to be written."""
        self.refused = 0
        """Messages not stored because the directory is full or the disk failed: they are held in memory only."""
        self.puts = 0
        """Messages accepted since the start; if it grew, there is something to flush."""
        self._flushed_puts = 0
        # Used by the caller's thread only. A write that has not started is canceled when its message is delivered.
        self._writes: dict[int, Future[None]] = {}
        # Used by the writer thread only.
        self._unsynced: dict[int, Path] = {}
        self._unremoved: set[int] = set()
        self._removal_timer: threading.Timer | None = None
        self._disk = ThreadPoolExecutor(max_workers=1, thread_name_prefix="outbox")

    def lock(self) -> DirectoryLock:
        """Creates and locks the directory. Raises OSError if another process or store has locked it."""
        return DirectoryLock(self._directory, mode=DIRECTORY_MODE)

    def check_writable(self) -> None:
        """Reports an unusable directory now rather than with the first message."""
        self._disk.submit(self._check_writable)

    def _check_writable(self) -> None:
        try:
            self._make_directory()
            with tempfile.TemporaryFile(dir=self._directory):
                pass
        except OSError as error:
            log.error("outbox-unusable directory=%s error=%s", self._directory, error)

    def _make_directory(self) -> None:
        self._directory.mkdir(parents=True, exist_ok=True, mode=DIRECTORY_MODE)

    def put(self, message: StoredMessage) -> bool:
        """Queues the message to be written. Returns False, counted and logged, if it exceeds the limit; a later disk
        error is counted and logged as well, and `holds` is then false."""
        head = json.dumps(
            {
                "key": message.key,
                "peer": message.peer,
                "topic": message.topic,
                "type": message.type_name,
                "remaining_s": message.remaining_s,
                "bytes": len(message.payload),
            }
        ).encode()
        size = len(head) + 1 + _CHECKSUM_BYTES + 1 + len(message.payload)
        with self._lock:
            more = size - self._sizes.get(message.key, 0)
            if self.bytes + more > self._limit_bytes:
                details = f"directory={self._directory} bytes={self.bytes} limit={self._limit_bytes}"
                self._refuse("outbox-full", details)
                return False
            self.bytes += more
            self._sizes[message.key] = size
        self.puts += 1
        self._writes[message.key] = self._disk.submit(self._write, message.key, head, message.payload)
        return True

    def _write(self, key: int, head: bytes, payload: bytes) -> None:
        path = self._path(key)
        temporary = path.with_suffix(".new")
        try:
            self._make_directory()
            with temporary.open("wb") as file:
                file.write(b"%b %08x\n" % (head, _checksum(head, payload)))
                file.write(payload)
            temporary.rename(path)
        except OSError as error:
            # The disk is full: remove the partial file.
            self._give_up(key, temporary, error)
            return
        self._unsynced[key] = path
        self._unremoved.discard(key)

    def _give_up(self, key: int, path: Path, error: OSError) -> None:
        """The disk failed: the message is in memory only."""
        try:
            path.unlink(missing_ok=True)
        except OSError:
            self._remove_later(key)
        with self._lock:
            self.bytes -= self._sizes.pop(key, 0)
            self._refuse("outbox-write-failed", f"path={path} error={error}")

    def _refuse(self, event: str, details: str) -> None:
        """Counts every refusal but limits the log lines."""
        self.refused += 1
        self._log(event, f"held-in-memory={self.refused} {details}")

    def _log(self, event: str, details: str) -> None:
        """A disk stays full, or broken, for long."""
        now = time.monotonic()
        if now - self._logged_at >= LOG_AGAIN_S:
            self._logged_at = now
            log.error("%s %s", event, details)

    def remove(self, key: int) -> None:
        with self._lock:
            size = self._sizes.pop(key, None)
            if size is None:
                return
            self.bytes -= size
        write = self._writes.pop(key, None)
        if write is not None:
            write.cancel()
        self._disk.submit(self._unlink, key)

    def _unlink(self, key: int) -> None:
        self._unsynced.pop(key, None)
        if not self._is_unlinked(key):
            self._remove_later(key)

    def _is_unlinked(self, key: int) -> bool:
        path = self._path(key)
        try:
            path.unlink(missing_ok=True)
        except NotADirectoryError:
            return True
        except OSError as error:
            self._log("outbox-remove-failed", f"path={path} error={error}")
            return False
        return True

    def _remove_later(self, *keys: int) -> None:
        self._unremoved.update(keys)
        if self._unremoved and self._removal_timer is None:
            self._removal_timer = threading.Timer(REMOVE_AGAIN_S, self._request_removal)
            self._removal_timer.daemon = True
            self._removal_timer.start()

    def _request_removal(self) -> None:
        # closed meanwhile
        with contextlib.suppress(RuntimeError):
            self._disk.submit(self._remove_again)

    def _remove_again(self) -> None:
        self._removal_timer = None
        self._unremoved = {key for key in self._unremoved if not self._is_unlinked(key)}
        self._remove_later()

    def holds(self, key: int) -> bool:
        """Whether it is on disk or queued to be written."""
        with self._lock:
            return key in self._sizes

    def load(self) -> list[StoredMessage]:
        return list(self.read_all())

    def read_all(self) -> Iterator[StoredMessage]:
        """What `load` returns, one by one: the payloads of all may be more than the memory. Read it to its end."""
        # A node that starts again with its store may find the writes of its last run still under way.
        # After `close` there are none.
        with contextlib.suppress(RuntimeError):
            self._disk.submit(lambda: None).result()
        for path in sorted(self._directory.glob(f"*{SUFFIX}")):
            message = _read(path)
            if message is None or self._path(message.key) != path:
                # Keep the file for inspection, but do not load it again.
                log.error("outbox-damaged path=%s", path)
                with contextlib.suppress(OSError):
                    path.rename(path.with_suffix(".damaged"))
                continue
            size = path.stat().st_size
            with self._lock:
                self.bytes += size - self._sizes.get(message.key, 0)
                self._sizes[message.key] = size
            yield message
        for leftover in self._directory.glob("*.new"):
            with contextlib.suppress(OSError):
                leftover.unlink()

    def read(self, key: int) -> StoredMessage | None:
        """One message from the disk; None if it is not there or damaged. Blocks."""
        return _read(self._path(key))

    @property
    def needs_flush(self) -> bool:
        return self._flushed_puts < self.puts

    def flush(self) -> Future[None]:
        """Returns a future that is done when everything put so far and not removed is on disk."""
        self._flushed_puts = self.puts
        self._writes = {key: write for key, write in self._writes.items() if not write.done()}
        return self._disk.submit(self._sync_all)

    def _sync_all(self) -> None:
        unsynced, self._unsynced = self._unsynced, {}
        written: list[tuple[int, Path]] = []
        for key, path in sorted(unsynced.items()):
            try:
                _sync(path, os.O_RDONLY)
                written.append((key, path))
            except OSError as error:
                self._give_up(key, path, error)
        try:
            if written:
                _sync(self._directory, os.O_RDONLY | os.O_DIRECTORY)
        except OSError as error:
            for key, path in written:
                self._give_up(key, path, error)

    def close(self) -> None:
        """Waits until everything put is written and everything removed is gone, if the disk permits it."""
        self._disk.submit(self._remove_again)
        self._disk.shutdown()
        if self._removal_timer is not None:
            self._removal_timer.cancel()

    def _path(self, key: int) -> Path:
        return self._directory / f"{key:020d}{SUFFIX}"


class Flusher:
    """Runs one flush at a time; callers that arrive meanwhile share the next one."""

    def __init__(self, store: DirectoryStore) -> None:
        self._store = store
        self._turn = asyncio.Lock()

    async def flush(self) -> None:
        """Returns when everything put before the call is on disk."""
        async with self._turn:
            if self._store.needs_flush:
                await asyncio.wrap_future(self._store.flush())


def _sync(path: Path, flags: int) -> None:
    descriptor = os.open(path, flags | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _checksum(head: bytes, payload: bytes) -> int:
    return zlib.crc32(payload, zlib.crc32(head))


def _read(path: Path) -> StoredMessage | None:
    """The message in a file; None if it is damaged."""
    try:
        line, _, payload = path.read_bytes().partition(b"\n")
        head, _, checksum = line.rpartition(b" ")
        if int(checksum, 16) != _checksum(head, payload):
            return None
        fields = json.loads(head)
        if len(payload) != fields["bytes"]:
            return None
        remaining = fields["remaining_s"]
        return StoredMessage(
            key=int(fields["key"]),
            peer=str(fields["peer"]),
            topic=str(fields["topic"]),
            type_name=str(fields["type"]),
            payload=payload,
            remaining_s=None if remaining is None else float(remaining),
        )
    except (OSError, ValueError, KeyError, TypeError):
        return None
