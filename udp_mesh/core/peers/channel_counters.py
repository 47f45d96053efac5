"""What must outlive a session: how far the numbers of its channels have come, in either direction.

A boot that was forgotten (silent for long, its name taken by another run) may come back. Numbers that began again would
seal under nonces already used, and open recordings a second time. So what a session counted is kept, and a session
made for the same boot goes on from there. Past `MAX_BOOTS` the oldest is dropped; sending to any boot not remembered
then starts above every number ever dropped, so that no number is used twice however many boots there were.
"""

from __future__ import annotations

from dataclasses import dataclass

from udp_mesh.core.peers.session import Session
from udp_mesh.core.ranges import RangeSet
from udp_mesh.core.receiver.datagram_age import Freshness

MAX_BOOTS = 1024
"""Earlier runs of a fleet's nodes that one run meets; about 1 kB each. Only a key holder makes more."""


@dataclass(frozen=True, slots=True)
class _Record:
    name: str
    next_number: int
    next_wire_id: int
    floors: dict[tuple[bytes, bytes], int]
    finished: tuple[RangeSet, RangeSet]
    freshness: Freshness


class BootMemory:
    """Records of forgotten sessions by boot id, the longest unseen first."""

    __slots__ = ("_records", "_send_floor")

    def __init__(self) -> None:
        self._records: dict[bytes, _Record] = {}
        self._send_floor = 0

    def __len__(self) -> int:
        return len(self._records)

    def save(self, session: Session) -> None:
        """The session goes. One that was never proven, and to which nothing was sent, leaves nothing behind."""
        number = session.path.channel.next_number
        if not (session.verified or session.restored or number):
            return
        receiver = session.receiver
        self._records.pop(session.boot_id, None)
        self._records[session.boot_id] = _Record(
            session.name,
            number,
            session.next_wire_id,
            session.floors(),
            (receiver.unicasts.finished, receiver.broadcasts.finished),
            session.freshness,
        )
        while len(self._records) > MAX_BOOTS:
            dropped = self._records.pop(next(iter(self._records)))
            self._send_floor = max(self._send_floor, dropped.next_number)

    def restore(self, session: Session) -> None:
        """A session made for a boot: it goes on where an earlier one for the same boot stopped."""
        record = self._records.pop(session.boot_id, None)
        channel = session.path.channel
        if record is None:
            channel.next_number = max(channel.next_number, self._send_floor)
            return
        channel.next_number = max(record.next_number, self._send_floor)
        session.next_wire_id = record.next_wire_id
        session.restore_floors(record.floors)
        session.receiver.unicasts.finished, session.receiver.broadcasts.finished = record.finished
        session.freshness = record.freshness
        session.restored = True
        session.replaced = record.name == session.name
