"""What happens, written to a file for `udp-mesh report`: one JSON object per line (docs/recording-format.md).

The first line names the node and the start, in seconds since 1970. Every other line has `t`, seconds since the start
on the monotonic clock, and `kind`: `sent`, `received`, every event's name, and `conditions` once per period. Lines
are flushed with each `conditions`, so that a killed daemon loses a period at most. A full file ends the recording,
not the daemon.
"""

from __future__ import annotations

import base64
import json
import logging
from pathlib import Path

from udp_mesh.core.conditions import Conditions
from udp_mesh.core.events import Event, MessageReceived
from udp_mesh.daemon.status import Json, conditions_json, event_json

log = logging.getLogger(__name__)

FORMAT_VERSION = 1


class Recorder:
    """One open recording."""

    def __init__(
        self, path: Path, *, node: str, boot_id: bytes, wall_s: float, now: float, limit_bytes: int, payloads: bool
    ) -> None:
        """Raises OSError where the file cannot be made; an existing file is never overwritten (FileExistsError)."""
        self.path = path
        self.bytes = 0
        self.lines = 0
        self._start = now
        self._payloads = payloads
        self._limit_bytes = limit_bytes
        self._file = path.open("xb")
        self._write(
            {
                "recording": FORMAT_VERSION,
                "node": node,
                "boot": boot_id.hex(),
                "started": wall_s,
                "payloads": payloads,
            }
        )

    @property
    def open(self) -> bool:
        return not self._file.closed

    def sent(
        self, now: float, *, message: int, topic: str, priority: int, size: int, destination: str | None, reliable: bool
    ) -> None:
        """A message that the core accepted; `destination` None is the topic's destinations, or all."""
        self._write(
            {
                "t": self._at(now),
                "kind": "sent",
                "message": message,
                "topic": topic,
                "priority": priority,
                "bytes": size,
                "to": destination,
                "reliable": reliable,
            }
        )

    def event(self, now: float, event: Event) -> None:
        fields = event_json(event)
        kind = fields.pop("event")
        if isinstance(event, MessageReceived):
            kind = "received"
            if self._payloads:
                fields["payload"] = base64.b64encode(event.payload).decode()
        self._write({"t": self._at(now), "kind": kind, **fields})

    def conditions(self, conditions: Conditions) -> None:
        self._write({"t": self._at(conditions.now), "kind": "conditions", **conditions_json(conditions)})
        if self.open:
            self._file.flush()

    def _at(self, now: float) -> float:
        return round(now - self._start, 6)

    def _write(self, fields: Json) -> None:
        if not self.open:
            return
        line = json.dumps(fields, separators=(",", ":")).encode() + b"\n"
        if self.bytes + len(line) > self._limit_bytes:
            log.error("recording-full path=%s bytes=%d", self.path, self.bytes)
            self.close()
            return
        try:
            self._file.write(line)
        except OSError as error:
            log.error("recording-failed path=%s error=%s", self.path, error)
            self.close()
            return
        self.bytes += len(line)
        self.lines += 1

    def close(self) -> None:
        if self._file.closed:
            return
        try:
            self._file.close()
        except OSError as error:
            log.error("recording-close-failed path=%s error=%s", self.path, error)
