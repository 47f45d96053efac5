"""Writes events to a file for `udp-mesh report`: one JSON object per line (docs/recording-format.md).

The first line names the node and the start time in seconds since 1970. Every other line has `t`, seconds since the
start on the monotonic clock, and `kind`: `sent`, `received`, an event's name, or `conditions` once per period. A thread
writes the lines, at the latest with each `conditions`, so that a killed daemon loses one period at most and no caller
waits for the disk. If the disk does not keep up, lines are dropped and a `gap` line counts them. Reaching the size
limit ends the recording, not the daemon.
"""

from __future__ import annotations

import base64
import json
import logging
import threading
from collections.abc import Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path

from udp_mesh.core.conditions import Conditions
from udp_mesh.core.events import Event, MessageDelivered, MessageExpired, MessagePeerLost, MessageReceived
from udp_mesh.core.logs.conditions import LogConditions
from udp_mesh.core.thin.conditions import ThinConditions
from udp_mesh.core.versions.conditions import VersionConditions
from udp_mesh.daemon.interface import RESERVED_PREFIX
from udp_mesh.daemon.positions import Position, position_json
from udp_mesh.daemon.radio_paths import RadioReport, with_radio
from udp_mesh.daemon.status import Json, conditions_json, event_json, log_json

log = logging.getLogger(__name__)

FORMAT_VERSION = 1
BATCH_BYTES = 64 << 10
"""Lines submitted together: submitting costs as much as ten lines."""
MAX_BACKLOG_BYTES = 32 << 20
"""Lines waiting for a disk that hangs: half a minute of recording at 10 Mbit/s."""


def _thin_fields(thin: ThinConditions) -> Json:
    return {
        "links": [
            {
                "name": link.name,
                "up": link.up,
                "airtime_s": round(link.airtime_s, 6),
                "queued_messages": link.queued_messages,
                **asdict(link.counters),
            }
            for link in thin.links
        ],
        "peers": [{"name": peer.name, "present": peer.present, "only_thin": peer.only_thin} for peer in thin.peers],
    }


class Recorder:
    """One open recording."""

    def __init__(
        self, path: Path, *, node: str, boot_id: bytes, wall_s: float, now: float, limit_bytes: int, payloads: bool
    ) -> None:
        """Raises OSError if the file cannot be created; never overwrites a file (FileExistsError)."""
        self.path = path
        self.bytes = 0
        self.lines = 0
        self._start = now
        self._payloads = payloads
        self._limit_bytes = limit_bytes
        self._lines: list[bytes] = []
        self._lines_bytes = 0
        self._dropped_lines = 0
        # Guards what the caller's thread and the writer thread both change.
        self._lock = threading.Lock()
        self._submitted_bytes = 0
        self._ended = False
        self._closed: Future[None] | None = None
        self._file = path.open("xb")
        self._disk = ThreadPoolExecutor(max_workers=1, thread_name_prefix="recording")
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
        return not self._ended

    def sent(
        self, now: float, *, message: int, topic: str, priority: int, size: int, destination: str | None, reliable: bool
    ) -> None:
        """Records a message accepted by the core; `destination` None means the topic's destinations, or all."""
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
        """Records an event of the core, except outcomes of the daemon's own messages."""
        if isinstance(event, MessageDelivered | MessageExpired | MessagePeerLost) and event.topic.startswith(
            RESERVED_PREFIX
        ):
            return
        fields = event_json(event)
        kind = fields.pop("event")
        if isinstance(event, MessageReceived):
            kind = "received"
            if self._payloads:
                fields["payload"] = base64.b64encode(event.payload).decode()
        self._write({"t": self._at(now), "kind": kind, **fields})

    def position(self, now: float, name: str, position: Position) -> None:
        """Records where a node is; the report draws it."""
        fields = position_json(name, position, now)
        line = {"at": fields["name"], "x": fields["x_m"], "y": fields["y_m"], "z": fields["z_m"]}
        self._write({"t": self._at(now), "kind": "place", **line, "frame": fields["frame"], "age_s": fields["age_s"]})

    def conditions(
        self,
        conditions: Conditions,
        versions: Iterable[VersionConditions] = (),
        logs: Iterable[LogConditions] = (),
        thin: ThinConditions | None = None,
        radio: RadioReport | None = None,
    ) -> None:
        measured = conditions_json(conditions)
        if radio is not None:
            measured = with_radio(measured, radio, conditions.now)
        fields: Json = {"t": self._at(conditions.now), "kind": "conditions", **measured}
        if thin is not None:
            fields["thin"] = _thin_fields(thin)
        if rows := [{"topic": entry.topic, **asdict(entry.counters)} for entry in versions]:
            fields["versions"] = rows
        if rows := [log_json(log) for log in logs]:
            fields["logs"] = rows
        self._write(fields)
        self._submit()

    def _at(self, now: float) -> float:
        return round(now - self._start, 6)

    def _write(self, fields: Json) -> None:
        if not self.open:
            return
        waiting = self._submitted_bytes + self._lines_bytes
        # A few long gaps are more useful than many short ones.
        if self._dropped_lines and waiting <= MAX_BACKLOG_BYTES // 2:
            left_out, self._dropped_lines = self._dropped_lines, 0
            log.error("recording-gap path=%s lines=%d", self.path, left_out)
            self._write({"t": fields["t"], "kind": "gap", "lines": left_out})
        line = json.dumps(fields, separators=(",", ":")).encode() + b"\n"
        if self.bytes + len(line) > self._limit_bytes:
            log.error("recording-full path=%s bytes=%d", self.path, self.bytes)
            self.close()
            return
        # A line larger than the whole backlog is accepted when the backlog is empty.
        if self._dropped_lines or (waiting and waiting + len(line) > MAX_BACKLOG_BYTES):
            self._dropped_lines += 1
            return
        self.bytes += len(line)
        self.lines += 1
        self._lines.append(line)
        self._lines_bytes += len(line)
        if self._lines_bytes >= BATCH_BYTES:
            self._submit()

    def _submit(self) -> None:
        if not self._lines or not self.open:
            return
        batch = b"".join(self._lines)
        self._lines.clear()
        self._lines_bytes = 0
        with self._lock:
            self._submitted_bytes += len(batch)
        self._disk.submit(self._append, batch)

    def _append(self, batch: bytes) -> None:
        try:
            if not self._file.closed:
                self._file.write(batch)
                self._file.flush()
        except OSError as error:
            log.error("recording-failed path=%s error=%s", self.path, error)
            self._ended = True
            self._close()
        with self._lock:
            self._submitted_bytes -= len(batch)

    def close(self) -> Future[None]:
        """Ends the recording; the future is done when everything is written."""
        if self._closed is None:
            self._submit()
            self._ended = True
            self._closed = self._disk.submit(self._close)
            self._disk.shutdown(wait=False)
        return self._closed

    def _close(self) -> None:
        try:
            self._file.close()
        except OSError as error:
            log.error("recording-close-failed path=%s error=%s", self.path, error)
