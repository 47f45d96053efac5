"""Saves the receive positions of legacy peers in a file, for the next run of the daemon.

A legacy sender never retransmits: what was in flight to a daemon that stopped would occupy its slots for 10 s. The file
is only useful after a restart within that time, so nothing waits until it is on disk, and it is overwritten in place:
replacing it would make some file systems write it at once.
"""

from __future__ import annotations

import asyncio
import json
import logging
import os
from collections.abc import Mapping
from pathlib import Path

from udp_mesh.core.legacy.acks import MAX_BEHIND, ReceivePosition
from udp_mesh.wire.legacy import LAST_SEQUENCE
from udp_mesh.wire.limits import MAX_LEGACY_FRAGMENTS

log = logging.getLogger(__name__)

MAX_FILE_BYTES = 1 << 20


class LegacyPositions:
    """The file, and what it holds."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._turn = asyncio.Lock()
        self.saved = load_positions(path)

    @property
    def is_saving(self) -> bool:
        """Whether a save is in progress. On a disk that hangs, it remains so."""
        return self._turn.locked()

    async def save(self, positions: Mapping[str, ReceivePosition]) -> None:
        """Saves what was received from legacy peers, if it changed; first waits for a save in progress, which would
        otherwise write its older positions over these."""
        async with self._turn:
            if positions == self.saved:
                return
            self.saved = dict(positions)
            try:
                await asyncio.get_running_loop().run_in_executor(None, save_positions, self._path, positions)
            except OSError as error:
                log.warning("legacy-positions-not-saved path=%s error=%s", self._path, error)


def load_positions(path: Path) -> dict[str, ReceivePosition]:
    """The positions by peer; none if there is no file, or if it was being written when the computer stopped."""
    try:
        with path.open("rb") as file:
            entries = json.loads(file.read(MAX_FILE_BYTES))
        return {str(name): _position(*entry) for name, entry in entries.items()}
    except FileNotFoundError:
        return {}
    except (OSError, ValueError, TypeError, AttributeError, RecursionError) as error:
        log.warning("legacy-positions-unreadable path=%s error=%s", path, error)
        return {}


def _position(latest: int, recent: list[list[int]]) -> ReceivePosition:
    entries = tuple([(int(sequence), int(expected), int(total)) for sequence, expected, total in recent[:MAX_BEHIND]])
    for sequence, expected, total in ((latest, 0, 0), *entries):
        if not 1 <= sequence <= LAST_SEQUENCE or not 0 <= expected <= total <= MAX_LEGACY_FRAGMENTS:
            raise ValueError(f"expected a message number of 1-{LAST_SEQUENCE}, found {sequence}: {expected}/{total}")
    return ReceivePosition(latest, entries)


def save_positions(path: Path, positions: Mapping[str, ReceivePosition]) -> None:
    """Write the file, padded to the length it had. Raises OSError."""
    data = json.dumps(positions).encode()
    path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    try:
        os.pwrite(descriptor, data.ljust(os.fstat(descriptor).st_size), 0)
    finally:
        os.close(descriptor)
