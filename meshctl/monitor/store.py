"""The history of a fleet: frames and alarms in one SQLite file, bounded in age and size.

WAL: a killed monitor leaves every appended frame readable, and other processes read while it writes. A frame that
cannot be written (full disk) is still the latest one of this process, and the alarms of the meantime are written with
the next frame that can be. Readers hold no transaction open between calls, so SQLite's log stays small.
"""

from __future__ import annotations

import fcntl
import os
import threading
import zlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from meshctl.errors import InputError, MeshctlError
from meshctl.fleet.alarm_actions import AlarmAction, AlarmActionKind
from meshctl.fleet.sqlite_file import SqliteFile
from meshctl.monitor.alarm_log import (
    FLEET,
    REOPEN_S,
    AlarmChange,
    AlarmKey,
    LoggedAlarm,
    Silence,
    advance,
    devices_of,
    reported_alarms,
)
from meshctl.monitor.frame import Frame
from meshctl.monitor.history_file import (
    ALARM_COLUMNS,
    ANY,
    LOG_ALARM,
    LOG_BYTES,
    SCHEMA,
    alarm_of,
    milliseconds,
    row_of,
    silence_of,
    statement_of,
)
from meshctl.monitor.timeline import TimelineBucket, buckets_of, thinned

# Below this a frame of a large fleet and its indexes would not fit.
MIN_BYTES = 8 << 20
# Oldest frames removed at a time while the file is too large: no more than necessary.
_EXPIRE_BATCH = 2
# Steps in one transaction, so that it stays short when a limit was lowered.
_EXPIRE_STEPS = 32
_REMOVE_OLDEST = "DELETE FROM frames WHERE time_ms IN (SELECT time_ms FROM frames WHERE time_ms < ? ORDER BY 1 LIMIT ?)"
# Unused pages are given back to the disk in steps of 1 MiB.
_VACUUM_PAGES = 256
_READ_BATCH = 32
# Level 1 packs a frame six times as fast as the default, and 15 % larger.
_ZLIB_LEVEL = 1


Revision = tuple[int, float | None]

_LISTED = "`meshctl alarms list --all` lists them"


class FrameStore:
    """The open history. Safe for several threads; one process appends, others may read, acknowledge and silence.

    `problem` says why the last frame is not in the file; empty if it is. `clock_stepped_s` is by how much the clock was
    set forward since the file was opened: frames from before are not that much older. `on_action` receives
    what an operator did about an alarm through this object.
    """

    def __init__(self, path: Path, max_age_s: float, max_bytes: int, *, read_only: bool = False) -> None:
        self.path = path
        self.problem = ""
        self.clock_stepped_s = 0.0
        self._max_age_ms = milliseconds(max_age_s)
        self._max_used_bytes = max_bytes - LOG_BYTES
        self._file = SqliteFile(path, SCHEMA, read_only=read_only)
        try:
            # reads do not wait for an append
            self._reader = SqliteFile(path, SCHEMA, read_only=read_only)
        except MeshctlError:
            self._file.close()
            raise
        self.on_action: Callable[[AlarmAction], None] = lambda action: None
        self._claim: int | None = None
        self._lock = threading.Lock()
        self._unwritten: Frame | None = None
        self._open: dict[AlarmKey, LoggedAlarm] = {}
        self._ended: dict[AlarmKey, LoggedAlarm] = {}
        self._pending: dict[tuple[str, str, float], LoggedAlarm] = {}
        self._last_ms = self._newest_ms()
        self._load_alarms()

    @classmethod
    def open(cls, path: Path, max_age_s: float, max_bytes: int) -> FrameStore:
        """Open the file, or create it. Raises MeshctlError; ValueError for limits that hold no frame."""
        if max_age_s <= 0 or max_bytes < MIN_BYTES:
            raise ValueError(f"expected an age above 0 s and at least {MIN_BYTES} bytes")
        return cls(path, max_age_s, max_bytes)

    @classmethod
    def open_running(cls, path: Path) -> FrameStore:
        """Open the file of a monitor that may be running, to read it, acknowledge and silence. Raises InputError."""
        if not path.is_file():
            raise InputError(f"{path}: no history", hint="`meshctl monitor` writes it; or name another with --store")
        # only an append removes anything
        return cls(path, 0.0, MIN_BYTES)

    @classmethod
    def open_recording(cls, path: Path) -> FrameStore:
        """Open an existing file for reading alone, on a read-only disk, too. Raises InputError, MeshctlError."""
        if not path.is_file():
            raise InputError(f"{path}: no such file", hint="expected a history that `meshctl monitor` wrote")
        return cls(path, 0.0, MIN_BYTES, read_only=True)

    def __enter__(self) -> FrameStore:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def close(self) -> None:
        self._reader.close()
        self._file.close()
        if self._claim is not None:
            os.close(self._claim)
            self._claim = None

    def claim(self) -> None:
        """Be the process that appends, until `close`. Raises InputError if another one is."""
        lock = self.path.with_name(f"{self.path.name}.lock")
        try:
            descriptor = os.open(lock, os.O_CREAT | os.O_RDWR | os.O_CLOEXEC, 0o600)
        except OSError as error:
            raise InputError(f"{lock}: cannot be created: {error.strerror}") from error
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            os.close(descriptor)
            hint = "use the page of that one, or choose another file with --store"
            raise InputError(f"{self.path}: another meshctl monitor writes this history", hint=hint) from error
        self._claim = descriptor

    def append(self, frame: Frame, now_s: float | None = None) -> tuple[LoggedAlarm, ...]:
        """Store a frame, bring the alarm log up to date and drop what is too old or too much; the alarms that began.
        `now_s` by the wall clock, which silences are set by, decides which are in force; default: the frame's time.

        A frame that cannot be written (full disk, locked file) sets `problem`: `latest` still returns it, and what
        became of the alarms is written with the next one. Raises ValueError if it is not newer than the last one.
        """
        key = milliseconds(frame.time_s)
        if self._last_ms is not None and key <= self._last_ms:
            raise ValueError(f"frame at {frame.time_s} is not newer than {self._last_ms / 1000}")
        with self._lock:
            self._last_ms, self._unwritten = key, frame
            change = advance(self._open, self._ended, reported_alarms(frame.status), frame.time_s)
            self._follow(change, frame.time_s)
            pending = dict(self._pending)
            try:
                self._write(frame, key, pending)
            except MeshctlError as error:
                self.problem = f"{error}; {error.hint}" if error.hint else str(error)
            else:
                self.problem = ""
                self._unwritten = None
                self._pending.clear()
        return self._with_silences(change.began, frame.time_s if now_s is None else now_s)

    def _with_silences(self, alarms: tuple[LoggedAlarm, ...], now_s: float) -> tuple[LoggedAlarm, ...]:
        if not alarms:
            return ()
        try:
            silences = self.silences(now_s)
        except MeshctlError:
            # better reported although silenced than never
            return alarms
        return tuple(replace(alarm, silenced=silence_of(alarm.key, silences)) for alarm in alarms)

    def _follow(self, change: AlarmChange, now_s: float) -> None:
        self._open = dict(change.open)
        self._ended = {
            key: alarm
            for key, alarm in self._ended.items()
            if key not in self._open and alarm.ended_s is not None and now_s - alarm.ended_s <= REOPEN_S
        }
        self._ended.update((alarm.key, alarm) for alarm in change.ended)
        for alarm in (*change.open.values(), *change.ended):
            key = (alarm.device, alarm.code, alarm.first_s)
            unwritten = self._pending.get(key)
            self._pending[key] = (
                replace(alarm, has_risen=True) if unwritten is not None and unwritten.has_risen else alarm
            )

    def _write(self, frame: Frame, key: int, alarms: Mapping[Any, LoggedAlarm]) -> None:
        packed = zlib.compress(frame.json_text.encode(), _ZLIB_LEVEL)
        summary = frame.summary
        go = None if summary.go is None else int(summary.go)
        with self._file.write() as database:
            database.execute(
                "INSERT INTO frames (time_ms, go, errors, warnings, notes, document) VALUES (?, ?, ?, ?, ?, ?)",
                (key, go, summary.errors, summary.warnings, summary.notes, packed),
            )
            database.executemany(LOG_ALARM, [row_of(alarm) for alarm in alarms.values()])
            self._expire(database, key)

    def _expire(self, database: Any, now_ms: int) -> None:
        """Remove what is too old, and the oldest frames while the file is too large; never the newest frame."""
        oldest = now_ms - self._max_age_ms - milliseconds(self.clock_stepped_s)
        database.execute(_REMOVE_OLDEST, (oldest, _EXPIRE_BATCH * _EXPIRE_STEPS))
        database.execute("DELETE FROM alarms WHERE ended_ms IS NOT NULL AND ended_ms < ?", (oldest,))
        for _ in range(_EXPIRE_STEPS):
            if self._used_bytes(database) <= self._max_used_bytes:
                break
            database.execute(_REMOVE_OLDEST, (now_ms, _EXPIRE_BATCH))
        if _pragma(database, "freelist_count") > 2 * _VACUUM_PAGES:
            # Python steps a statement without columns once, which vacuums one page
            for _ in range(_VACUUM_PAGES):
                database.execute("PRAGMA incremental_vacuum(1)")

    def _used_bytes(self, database: Any) -> int:
        pages = _pragma(database, "page_count") - _pragma(database, "freelist_count")
        return pages * _pragma(database, "page_size")

    def latest(self) -> Frame | None:
        """The newest frame, written or not."""
        if (unwritten := self._unwritten) is not None:
            return unwritten
        return self._first("ORDER BY time_ms DESC LIMIT 1", ())

    def revision(self) -> Revision:
        """Differs from an earlier one if frames, alarms or silences changed since, also by another process."""
        unwritten = self._unwritten
        ((version,),) = self._reader.read("PRAGMA data_version", ())
        return version, None if unwritten is None else unwritten.time_s

    def at(self, time_s: float) -> Frame | None:
        """The newest frame that is not after `time_s`."""
        unwritten = self._unwritten
        if unwritten is not None and milliseconds(unwritten.time_s) <= milliseconds(time_s):
            return unwritten
        return self._first("WHERE time_ms <= ? ORDER BY time_ms DESC LIMIT 1", (milliseconds(time_s),))

    def between(self, start_s: float, end_s: float, limit: int) -> Iterator[Frame]:
        """The frames from `start_s` to `end_s`, thinned evenly to at most `limit`, with the first and the last. Each is
        read when it is asked for."""
        if limit < 1:
            return
        rows = self._reader.read(
            "SELECT time_ms FROM frames INDEXED BY timeline WHERE time_ms BETWEEN ? AND ? ORDER BY time_ms",
            (milliseconds(start_s), milliseconds(end_s)),
        )
        for key in thinned([row[0] for row in rows], limit):
            frame = self._first("WHERE time_ms = ?", (key,))
            # removed by retention meanwhile
            if frame is not None:
                yield frame

    def after(self, time_s: float) -> Iterator[Frame]:
        """All frames newer than `time_s`, oldest first, as they are in the file now, then the one not written."""
        last = milliseconds(time_s)
        while True:
            # before the query: every older frame that was written is in its answer
            unwritten = self._unwritten
            rows = self._reader.read(
                "SELECT time_ms, document FROM frames WHERE time_ms > ? ORDER BY time_ms LIMIT ?", (last, _READ_BATCH)
            )
            for key, packed in rows:
                last = key
                if (frame := _frame(key, packed)) is not None:
                    yield frame
            if len(rows) < _READ_BATCH:
                break
        if unwritten is not None and milliseconds(unwritten.time_s) > last:
            yield unwritten

    def span(self) -> tuple[float, float] | None:
        """The times of the oldest and the newest frame; None without any."""
        ((first, last),) = self._reader.read("SELECT min(time_ms), max(time_ms) FROM frames", ())
        unwritten = self._unwritten
        if first is None:
            return None if unwritten is None else (unwritten.time_s, unwritten.time_s)
        return first / 1000, max(last / 1000, 0.0 if unwritten is None else unwritten.time_s)

    def count(self) -> int:
        """The number of frames."""
        ((count,),) = self._reader.read("SELECT count(*) FROM frames", ())
        return int(count)

    def timeline(self, start_s: float, end_s: float, buckets: int) -> tuple[TimelineBucket, ...]:
        """`buckets` equal stretches from `start_s` to `end_s`, from indexed columns alone."""
        start, end = milliseconds(start_s), milliseconds(end_s)
        if buckets < 1 or end <= start:
            return ()
        rows = self._reader.read(
            "SELECT (time_ms - ?1) * ?3 / (?2 - ?1), count(*), min(go), max(errors), max(warnings), max(notes)"
            " FROM frames INDEXED BY timeline WHERE time_ms >= ?1 AND time_ms < ?2 GROUP BY 1",
            (start, end, buckets),
        )
        return buckets_of(rows, start, end, buckets)

    def alarms(self, *, active_only: bool = True, now_s: float) -> tuple[LoggedAlarm, ...]:
        """The alarms that are open, or all that are kept; the most severe first, then the newest. `now_s` decides which
        silences are in force."""
        rows = self._reader.read(
            f"SELECT {ALARM_COLUMNS} FROM alarms WHERE ended_ms IS NULL OR NOT ?", (int(active_only),)
        )
        silences = self.silences(now_s)
        order = {"error": 0, "warning": 1}
        found = [alarm_of(row, silences) for row in rows]
        return tuple(
            sorted(found, key=lambda alarm: (alarm.ended_s is not None, order.get(alarm.level, 2), -alarm.first_s))
        )

    def silences(self, now_s: float) -> dict[AlarmKey, Silence]:
        """Those in force, by device and code; `*` stands for any."""
        rows = self._reader.read(
            "SELECT device, code, until_ms, reason, by FROM silences WHERE until_ms IS NULL OR until_ms > ?",
            (milliseconds(now_s),),
        )
        return {
            (device, code): Silence(None if until is None else until / 1000, reason, by)
            for device, code, until, reason, by in rows
        }

    def acknowledge(self, device: str, code: str, by: str, now_s: float) -> None:
        """Note that someone takes care of an open alarm. Raises InputError if none is open."""
        action = AlarmAction(AlarmActionKind.ACKNOWLEDGE, device, code, by, now_s)
        if not self.apply(action):
            raise InputError(f"{device or 'the fleet'} has no open alarm {code}", hint=_LISTED)
        self.on_action(action)

    def silence(self, device: str, code: str, silence: Silence, now_s: float) -> None:
        """Silence an alarm, now and when it comes again; `*` stands for any device or code. Raises InputError, also for
        a device that no frame or alarm has."""
        if not silence.reason.strip():
            raise InputError("expected a reason for the silence")
        if device not in (ANY, FLEET) and not self._knows(device):
            hint = "`meshctl inventory list` lists radios; robot:NAME is a computer"
            raise InputError(f"unknown device {device!r}", hint=hint)
        action = AlarmAction(AlarmActionKind.SILENCE, device, code, silence.by, now_s, silence.until_s, silence.reason)
        self.apply(action)
        self.on_action(action)

    def apply(self, action: AlarmAction) -> bool:
        """Do what an operator, perhaps on another computer, did about an alarm; whether there was such an alarm."""
        with self._file.write() as database:
            return database.execute(*statement_of(action)).rowcount > 0

    def _knows(self, device: str) -> bool:
        if (newest := self.latest()) is None or device in devices_of(newest.status):
            return True
        return bool(self._reader.read("SELECT 1 FROM alarms WHERE device = ? LIMIT 1", (device,)))

    def end_silence(self, device: str, code: str, by: str, now_s: float) -> None:
        """Raises InputError if there is none."""
        action = AlarmAction(AlarmActionKind.END_SILENCE, device, code, by, now_s)
        if not self.apply(action):
            raise InputError(f"{device or 'the fleet'} has no silence of {code}", hint=_LISTED)
        self.on_action(action)

    def _newest_ms(self) -> int | None:
        ((newest,),) = self._file.read("SELECT max(time_ms) FROM frames", ())
        return None if newest is None else int(newest)

    def _load_alarms(self) -> None:
        recent = (self._last_ms or 0) - milliseconds(REOPEN_S)
        rows = self._file.read(
            f"SELECT {ALARM_COLUMNS} FROM alarms WHERE ended_ms IS NULL OR ended_ms >= ? ORDER BY first_ms", (recent,)
        )
        for row in rows:
            alarm = alarm_of(row, {})
            (self._open if alarm.ended_s is None else self._ended)[alarm.key] = alarm

    def _first(self, where: str, values: tuple[object, ...]) -> Frame | None:
        rows = self._reader.read(f"SELECT time_ms, document FROM frames {where}", values)
        return _frame(*rows[0]) if rows else None


def _frame(time_ms: int, packed: bytes) -> Frame | None:
    """None for a document that the disk has damaged: the rest of the history is still worth showing."""
    try:
        return Frame(time_ms / 1000, zlib.decompress(packed).decode())
    except (zlib.error, UnicodeDecodeError):
        return None


def _pragma(database: Any, name: str) -> int:
    return int(database.execute(f"PRAGMA {name}").fetchone()[0])
