"""Operators' actions on alarms, shared with other operators' monitors through a shared journal.

An action goes into the database, or into the spool while that is out of reach; every monitor takes the actions of its
fleet that it has not seen. Their order in the database decides, not the clocks of the computers.
"""

from __future__ import annotations

import secrets
from dataclasses import dataclass
from enum import Enum

from meshctl.fleet.store import Store

# Older ones concern alarms and silences that are over, or that everybody knows.
_KEPT_S = 30 * 86400.0
_WAIT_S = 5.0


class AlarmActionKind(Enum):
    ACKNOWLEDGE = "acknowledge"
    SILENCE = "silence"
    END_SILENCE = "end silence"


@dataclass(frozen=True, slots=True)
class AlarmAction:
    """`device` and `code` name the alarm; `*` stands for any in a silence. `until_s` None is for good; times are Unix
    times."""

    kind: AlarmActionKind
    device: str
    code: str
    by: str
    at_s: float
    until_s: float | None = None
    reason: str = ""


class AlarmExchange:
    """The actions of one fleet in a shared journal. Safe for several threads."""

    def __init__(self, store: Store, fleet: str) -> None:
        self._store = store
        self._fleet = fleet
        self._last = 0

    def send(self, action: AlarmAction) -> None:
        """Pass it to the others. Raises MeshctlError if it can be kept nowhere."""
        until = None if action.until_s is None else round(action.until_s * 1000)
        self._store.put(
            [
                (
                    "INSERT INTO alarm_actions (fleet, action, device, code, at_ms, until_ms, reason, by, origin)"
                    " VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?) ON CONFLICT (origin) DO NOTHING",
                    (
                        *(self._fleet, action.kind.value, action.device, action.code, round(action.at_s * 1000), until),
                        *(action.reason, action.by, secrets.token_hex(16)),
                    ),
                )
            ],
            _WAIT_S,
        )

    def receive(self, now_s: float) -> tuple[AlarmAction, ...]:
        """The actions since the last call, this computer's too, in order; at first those of the last month. Raises
        MeshctlError while the database is out of reach."""
        rows = self._store.read(
            "SELECT id, action, device, code, by, at_ms, until_ms, reason FROM alarm_actions"
            " WHERE fleet = ? AND id > ? AND at_ms > ? ORDER BY id",
            (self._fleet, self._last, round((now_s - _KEPT_S) * 1000) if self._last == 0 else 0),
        )
        if rows:
            self._last = rows[-1][0]
        return tuple(
            AlarmAction(
                AlarmActionKind(kind), device, code, by, at / 1000, None if until is None else until / 1000, reason
            )
            for _, kind, device, code, by, at, until, reason in rows
        )

    def wait(self, timeout_s: float) -> bool:
        """Wait until the journal changes, or the time is over. Raises MeshctlError."""
        return self._store.wait_for_change(timeout_s)
