"""Channel counters that must outlive a session, in both directions.

A boot that was forgotten (silent for long, or its name taken by another boot) may return. Restarting its packet numbers
would reuse nonces and accept recorded datagrams again. So the counters of a session are saved, and a new session for
the same boot continues from them. Beyond `MAX_BOOTS` the oldest record is dropped; numbers sent to any boot without a
record then start above every dropped number, so that none is ever reused.
"""

from __future__ import annotations

from dataclasses import dataclass

from udp_mesh.core.peers.session import Session
from udp_mesh.core.peers.session_state import SessionEvent, SessionState
from udp_mesh.core.ranges import RangeSet
from udp_mesh.core.receiver.datagram_age import Freshness

MAX_BOOTS = 1024
"""Boots of the fleet's nodes seen during one run, about 1 kB each. Only a key holder can create more."""


@dataclass(frozen=True, slots=True)
class _Record:
    name: str
    next_number: int
    next_wire_id: int
    floors: dict[tuple[bytes, bytes], int]
    finished: tuple[RangeSet, RangeSet]
    unconfirmed: set[int]
    freshness: Freshness


class BootMemory:
    """Counters of forgotten sessions by boot id, least recently seen first."""

    __slots__ = ("_records", "_send_floor")

    def __init__(self) -> None:
        self._records: dict[bytes, _Record] = {}
        self._send_floor = 0

    def __len__(self) -> int:
        return len(self._records)

    def save(self, session: Session) -> None:
        """Save the counters of a session being dropped, unless it was never verified and nothing was sent to it."""
        number = session.path.channel.next_number
        if session.state is SessionState.NEW and not number:
            return
        receiver = session.receiver
        self._records.pop(session.boot_id, None)
        self._records[session.boot_id] = _Record(
            session.name,
            number,
            session.next_wire_id,
            session.floors(),
            (receiver.unicasts.finished, receiver.broadcasts.finished),
            receiver.unconfirmed,
            session.freshness,
        )
        while len(self._records) > MAX_BOOTS:
            dropped = self._records.pop(next(iter(self._records)))
            self._send_floor = max(self._send_floor, dropped.next_number)

    def restore(self, session: Session) -> None:
        """Continue the counters of an earlier session for the same boot."""
        record = self._records.pop(session.boot_id, None)
        channel = session.path.channel
        if record is None:
            channel.next_number = max(channel.next_number, self._send_floor)
            return
        channel.next_number = max(record.next_number, self._send_floor)
        session.next_wire_id = record.next_wire_id
        session.restore_floors(record.floors)
        session.receiver.unicasts.finished, session.receiver.broadcasts.finished = record.finished
        session.receiver.unconfirmed = record.unconfirmed
        session.freshness = record.freshness
        session.transition(
            SessionEvent.SAME_NAME_RESTORED if record.name == session.name else SessionEvent.OTHER_NAME_RESTORED
        )
