"""The legacy program as its published source (arpg/udp_mesh 678db24) has it: `RUdpPeer` without its sockets.

Sending: `window` fragments in flight in the order of priority, no retransmission; if one is unanswered for 10 s,
everything queued is dropped. Receiving: every fragment is acknowledged at once, finished messages are not remembered,
and one purge shares its `stale` flag between messages.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass, field

from udp_mesh.wire.legacy import (
    LAST_SEQUENCE,
    LegacyAck,
    LegacyPayload,
    PriorityMeshData,
    decode_mesh_data,
    encode_mesh_data,
    fragment_legacy,
)

OFFLINE_TIMEOUT_S = 10.0
WINDOW = 3


@dataclass
class LegacyProgram:
    """One peer of the program: `push` and `fill_in_flight` send, `on_ack` and `on_fragment` process what arrives."""

    queue: list[tuple[int, int, int, LegacyPayload]] = field(default_factory=list)
    in_flight: dict[tuple[int, int], float] = field(default_factory=dict)
    sequence: int = 0
    flushed: int = 0
    partials: dict[int, list[tuple[float, bytes] | None]] = field(default_factory=dict)

    # Sending

    def push(self, priority: int, data: bytes) -> None:
        self.push_message(PriorityMeshData("old", "std_msgs/String", priority, "t", data))

    def push_message(self, message: PriorityMeshData) -> None:
        self.sequence = self.sequence % LAST_SEQUENCE + 1
        chunks = fragment_legacy(encode_mesh_data(message))
        for place, chunk in enumerate(chunks):
            fragment = LegacyPayload(self.sequence, place, len(chunks), chunk, wants_ack=True)
            heapq.heappush(self.queue, (message.priority, self.sequence, place, fragment))

    def is_stalled(self, now: float) -> bool:
        """Whether a fragment has been unanswered for too long; then the program declares the peer offline."""
        return any(now - at > OFFLINE_TIMEOUT_S for at in self.in_flight.values())

    def flush(self) -> None:
        """Drops everything queued and in flight, as for a peer that is offline."""
        self.flushed += len(self.queue)
        self.queue.clear()
        self.in_flight.clear()

    def fill_in_flight(self, now: float) -> list[LegacyPayload]:
        """The fragments sent now."""
        if self.is_stalled(now):
            self.flush()
        out = []
        while self.queue and len(self.in_flight) < WINDOW:
            _, sequence, place, fragment = heapq.heappop(self.queue)
            self.in_flight[sequence, place] = now
            out.append(fragment)
        return out

    def on_ack(self, ack: LegacyAck) -> None:
        """An acknowledgment of a fragment that is not in flight is ignored."""
        self.in_flight.pop((ack.sequence, ack.position), None)

    # Receiving

    def on_fragment(self, fragment: LegacyPayload, now: float) -> tuple[LegacyAck, PriorityMeshData | None]:
        """Its acknowledgment, and the message that it completes."""
        held = self.partials.setdefault(fragment.sequence, [None] * fragment.total)
        held[fragment.position] = (now, fragment.data)
        ack = LegacyAck(fragment.sequence, fragment.position)
        whole = [entry[1] for entry in held if entry is not None]
        if len(whole) < fragment.total:
            return ack, None
        del self.partials[fragment.sequence]
        return ack, decode_mesh_data(b"".join(whole))

    def prune(self, now: float) -> None:
        stale, over = True, []
        for sequence, held in self.partials.items():
            if any(entry is not None and now - entry[0] < OFFLINE_TIMEOUT_S for entry in held):
                stale = False
            if stale:
                over.append(sequence)
        for sequence in over:
            del self.partials[sequence]
