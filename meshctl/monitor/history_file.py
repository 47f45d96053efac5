"""The tables of a history, and the rows of its alarms and silences as values."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from meshctl.fleet.alarm_actions import AlarmAction, AlarmActionKind
from meshctl.fleet.sqlite_file import Schema
from meshctl.monitor.alarm_log import Acknowledgment, AlarmKey, LoggedAlarm, Silence

# The size of the log beside the file: SQLite copies it back at this many pages of 4 KiB.
_CHECKPOINT_PAGES = 256
LOG_BYTES = 4 * _CHECKPOINT_PAGES * 4096
SCHEMA = Schema(
    name="history",
    version=1,
    space_hint="free space on its disk, or choose another file with --store",
    pragmas=(
        # before the first table; unused pages can be given back
        "auto_vacuum = INCREMENTAL",
        # Debian builds SQLite to overwrite what is removed, which doubles the writing
        "secure_delete = OFF",
        f"wal_autocheckpoint = {_CHECKPOINT_PAGES}",
        f"journal_size_limit = {LOG_BYTES}",
    ),
    statements="""
CREATE TABLE frames (
    time_ms INTEGER PRIMARY KEY, go INTEGER, errors INTEGER NOT NULL, warnings INTEGER NOT NULL, notes INTEGER NOT NULL,
    document BLOB NOT NULL
) STRICT;
CREATE INDEX timeline ON frames(time_ms, go, errors, warnings, notes);
CREATE TABLE alarms (
    device TEXT NOT NULL, code TEXT NOT NULL, first_ms INTEGER NOT NULL, last_ms INTEGER NOT NULL, ended_ms INTEGER,
    level TEXT NOT NULL, text TEXT NOT NULL, hint TEXT NOT NULL, acknowledged_by TEXT, acknowledged_ms INTEGER,
    PRIMARY KEY (device, code, first_ms)
) STRICT;
CREATE INDEX alarms_by_end ON alarms(ended_ms);
CREATE TABLE silences (
    device TEXT NOT NULL, code TEXT NOT NULL, until_ms INTEGER, reason TEXT NOT NULL, by TEXT NOT NULL,
    PRIMARY KEY (device, code)
) STRICT;
""",
)
LOG_ALARM = (
    "INSERT INTO alarms (device, code, first_ms, last_ms, ended_ms, level, text, hint)"
    " VALUES (?1, ?2, ?3, ?4, ?5, ?6, ?7, ?8) ON CONFLICT (device, code, first_ms)"
    " DO UPDATE SET last_ms = ?4, ended_ms = ?5, level = ?6, text = ?7, hint = ?8,"
    # the acknowledgment of a warning does not cover the error that it became
    " acknowledged_by = CASE WHEN ?9 THEN NULL ELSE acknowledged_by END,"
    " acknowledged_ms = CASE WHEN ?9 THEN NULL ELSE acknowledged_ms END"
)
ALARM_COLUMNS = "device, code, level, text, hint, first_ms, last_ms, ended_ms, acknowledged_by, acknowledged_ms"
# by how much the clocks of operators differ at most
_CLOCK_DIFFERENCE_MS = 60_000
# stands for every device, or every code, in a silence
ANY = "*"


def silence_of(alarm: AlarmKey, silences: Mapping[AlarmKey, Silence]) -> Silence | None:
    """The silence that covers an alarm, the most specific first."""
    device, code = alarm
    keys = ((device, code), (device, ANY), (ANY, code), (ANY, ANY))
    return next((silences[key] for key in keys if key in silences), None)


def alarm_of(row: tuple[Any, ...], silences: Mapping[AlarmKey, Silence]) -> LoggedAlarm:
    """The alarm of a row of `ALARM_COLUMNS`, with the silence that covers it."""
    device, code, level, text, hint, first, last, ended, by, at = row
    acknowledged = None if by is None or at is None else Acknowledgment(by, at / 1000)
    ended_s = None if ended is None else ended / 1000
    alarm = LoggedAlarm(device, code, level, text, hint, first / 1000, last / 1000, ended_s, acknowledged)
    return replace(alarm, silenced=silence_of(alarm.key, silences))


def row_of(alarm: LoggedAlarm) -> tuple[object, ...]:
    """The values of `LOG_ALARM`."""
    ended = None if alarm.ended_s is None else milliseconds(alarm.ended_s)
    return (
        *(alarm.device, alarm.code, milliseconds(alarm.first_s), milliseconds(alarm.last_s), ended),
        *(alarm.level, alarm.text, alarm.hint, int(alarm.has_risen)),
    )


def statement_of(action: AlarmAction) -> tuple[str, tuple[object, ...]]:
    """The statement that does what an operator did about an alarm, and its values."""
    alarm = (action.device, action.code)
    match action.kind:
        case AlarmActionKind.ACKNOWLEDGE:
            at = milliseconds(action.at_s)
            return (
                "UPDATE alarms SET acknowledged_by = ?, acknowledged_ms = ?"
                " WHERE device = ? AND code = ? AND ended_ms IS NULL AND first_ms <= ?",
                # an alarm that began since, whatever the clocks say, was not meant
                (action.by, at, *alarm, at + _CLOCK_DIFFERENCE_MS),
            )
        case AlarmActionKind.SILENCE:
            until = None if action.until_s is None else milliseconds(action.until_s)
            return (
                "INSERT OR REPLACE INTO silences (device, code, until_ms, reason, by) VALUES (?, ?, ?, ?, ?)",
                (*alarm, until, action.reason, action.by),
            )
        case AlarmActionKind.END_SILENCE:
            return "DELETE FROM silences WHERE device = ? AND code = ?", alarm


def milliseconds(time_s: float) -> int:
    return round(time_s * 1000)
