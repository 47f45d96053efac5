"""Messages held on disk for peers that are away: one file per message in one directory.

`put` writes a file under a temporary name and renames it: from then on it survives the end of this process (SIGKILL
too). `flush` makes everything put so far survive a power cut (fsync of files and directory), away from the event
loop; the daemon answers a publisher of such a topic after it. `load` reads what is kept, and sets aside what is
damaged. The directory is bounded: past `limit_bytes` a message is refused and counted rather than filling the disk.

A file is a line with the message's fields as JSON and the CRC-32 of these and the payload, then the payload.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import os
import time
import zlib
from pathlib import Path

from udp_mesh.core.seams import StoredMessage

log = logging.getLogger(__name__)

SUFFIX = ".message"
TELL_AGAIN_S = 60.0
"""Between two lines of the log that say the disk is full."""


class DirectoryStore:
    """The core's `Store` over a directory (made with the first message, readable by its owner only)."""

    def __init__(self, directory: Path, limit_bytes: int) -> None:
        self._directory = directory
        self._limit_bytes = limit_bytes
        self._sizes: dict[int, int] = {}
        self._unflushed: set[Path] = set()
        self._told_at = float("-inf")
        self.bytes = 0
        """Bytes of all files kept."""
        self.refused = 0
        """Messages not kept because the directory is full or the disk failed: they are held in memory only."""

    def put(self, message: StoredMessage) -> bool:
        """Keep it; False where the bound or the disk refuses, which is counted and logged."""
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
        head += f" {_checksum(head, message.payload):08x}".encode()
        size = len(head) + 1 + len(message.payload)
        more = size - self._sizes.get(message.key, 0)
        if self.bytes + more > self._limit_bytes:
            self._refuse("outbox-full", f"directory={self._directory} bytes={self.bytes} limit={self._limit_bytes}")
            return False
        path = self._path(message.key)
        temporary = path.with_suffix(".new")
        try:
            self._directory.mkdir(parents=True, exist_ok=True, mode=0o700)
            with temporary.open("wb") as file:
                file.write(head + b"\n")
                file.write(message.payload)
            temporary.rename(path)
        except OSError as error:
            self._refuse("outbox-write-failed", f"path={path} error={error}")
            # A full disk: what is half written must not keep it full.
            with contextlib.suppress(OSError):
                temporary.unlink(missing_ok=True)
            return False
        self.bytes += more
        self._sizes[message.key] = size
        self._unflushed.add(path)
        return True

    def _refuse(self, event: str, why: str) -> None:
        """Counted each time, logged now and then: a disk stays full for long."""
        self.refused += 1
        now = time.monotonic()
        if now - self._told_at >= TELL_AGAIN_S:
            self._told_at = now
            log.error("%s held-in-memory=%d %s", event, self.refused, why)

    def remove(self, key: int) -> None:
        size = self._sizes.pop(key, None)
        if size is None:
            return
        path = self._path(key)
        self.bytes -= size
        self._unflushed.discard(path)
        try:
            path.unlink(missing_ok=True)
        except OSError as error:
            log.error("outbox-remove-failed path=%s error=%s", path, error)

    def load(self) -> list[StoredMessage]:
        messages: list[StoredMessage] = []
        for path in sorted(self._directory.glob(f"*{SUFFIX}")):
            message = _read(path)
            if message is None or self._path(message.key) != path:
                # Kept for a person to look at, out of the way of the next start.
                log.error("outbox-damaged path=%s", path)
                with contextlib.suppress(OSError):
                    path.rename(path.with_suffix(".damaged"))
                continue
            size = path.stat().st_size
            self._sizes[message.key] = size
            self.bytes += size
            messages.append(message)
        for leftover in self._directory.glob("*.new"):
            with contextlib.suppress(OSError):
                leftover.unlink()
        return messages

    @property
    def needs_flush(self) -> bool:
        return bool(self._unflushed)

    def take_unflushed(self) -> list[Path]:
        """The files put since the last call, to be handed to `flush`."""
        paths = sorted(self._unflushed)
        self._unflushed.clear()
        return paths

    def flush(self, paths: list[Path]) -> None:
        """Waits until the disk holds these files; runs in a thread of its own. A file already removed is no error."""
        for path in paths:
            try:
                _sync(path, os.O_RDONLY)
            except FileNotFoundError:
                continue
            except OSError as error:
                log.error("outbox-flush-failed path=%s error=%s", path, error)
        try:
            if paths:
                _sync(self._directory, os.O_RDONLY | os.O_DIRECTORY)
        except OSError as error:
            log.error("outbox-flush-failed path=%s error=%s", self._directory, error)

    def _path(self, key: int) -> Path:
        return self._directory / f"{key:020d}{SUFFIX}"


class Flusher:
    """Flushes away from the loop, one round at a time: whoever comes meanwhile shares the next."""

    def __init__(self, store: DirectoryStore) -> None:
        self._store = store
        self._turn = asyncio.Lock()

    async def flush(self) -> None:
        """Returns when the disk has all that was put before: that may be in the hands of the round under way."""
        async with self._turn:
            paths = self._store.take_unflushed()
            if paths:
                await asyncio.get_running_loop().run_in_executor(None, self._store.flush, paths)


def _sync(path: Path, flags: int) -> None:
    descriptor = os.open(path, flags | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _checksum(head: bytes, payload: bytes) -> int:
    return zlib.crc32(payload, zlib.crc32(head))


def _read(path: Path) -> StoredMessage | None:
    """The message in a file; None where it is damaged."""
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
