"""The placement meter's readings, from the local udp_mesh daemon's topic `~mesh/meter` (docs/local-api.md).

`MeterReadings.run` works in a thread of its own until `stop`; without a daemon it tries again every few seconds.
"""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from meshctl.robots.local_daemon import DaemonError, LocalDaemon

METER_TOPIC = "~mesh/meter"
# `meshctl meter` publishes every second; an older reading is of another place.
MAX_AGE_S = 5.0
RETRY_S = 3.0


@dataclass(slots=True)
class MeterReadings:
    """The newest reading of each robot. `on_reading` is called in the thread for each one."""

    path: Path
    on_reading: Callable[[], None] = lambda: None
    monotonic: Callable[[], float] = time.monotonic
    _newest: dict[str, tuple[float, Mapping[str, Any]]] = field(default_factory=dict, repr=False)
    _lock: threading.Lock = field(default_factory=threading.Lock, repr=False)
    _end: threading.Event = field(default_factory=threading.Event, repr=False)

    def current(self) -> dict[str, Mapping[str, Any]]:
        """Readings that are not older than `MAX_AGE_S`, by robot."""
        now_s = self.monotonic()
        with self._lock:
            return {robot: meter for robot, (at_s, meter) in self._newest.items() if now_s - at_s <= MAX_AGE_S}

    def run(self) -> None:
        daemon = LocalDaemon(self.path)
        while not self._end.is_set():
            try:
                daemon.request("subscribe", topics=[METER_TOPIC])
                while not self._end.is_set():
                    if (event := daemon.event()) is not None and event[0].get("topic") == METER_TOPIC:
                        self.take(event[1])
            except DaemonError:
                self._end.wait(RETRY_S)
        daemon.close()

    def take(self, payload: bytes) -> None:
        """Keep one reading; what is none is left out."""
        try:
            reading = json.loads(payload)
        except (ValueError, RecursionError):
            return
        if isinstance(reading, dict) and isinstance(robot := reading.get("robot"), str):
            with self._lock:
                self._newest[robot] = (self.monotonic(), reading)
            self.on_reading()

    def stop(self) -> None:
        self._end.set()
