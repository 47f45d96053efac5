"""How many bytes go to and come from each device, for those who must bound what they put on the air."""

from __future__ import annotations

import threading


class TrafficMeter:
    """Counts by a device's name, in both directions, as they pass the socket. Thread-safe."""

    def __init__(self) -> None:
        self._bytes: dict[str, int] = {}
        self._lock = threading.Lock()

    def add(self, device: str, count: int) -> None:
        with self._lock:
            self._bytes[device] = self._bytes.get(device, 0) + count

    def totals(self) -> dict[str, int]:
        """Bytes by device since the meter was made."""
        with self._lock:
            return dict(self._bytes)
