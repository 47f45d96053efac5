"""Fragments of one peer of the fielded format -> whole messages, each once, within a memory cap.

Unlike the fielded receiver this one allocates nothing from the wire, remembers finished messages so that a repeated
fragment opens no new one, and gives an old partial message up when its number comes around again.
"""

from collections import OrderedDict

from udp_mesh.core.reassembly import PIECE_OVERHEAD_BYTES
from udp_mesh.core.settings import Limits
from udp_mesh.wire.legacy import LegacyPayload, PriorityMeshData, decode_mesh_data

PARTIAL_PATIENCE_S = 10.0
"""A message whose fragments stop for this long is given up (the fielded system's timeout)."""

FINISHED_REMEMBERED = 1024
"""Finished messages of one peer: far fewer than its 32,767 numbers, far more than its window of three."""

FINISHED_FOR_S = 30.0
"""A number finished this long ago may belong to a new message."""


class _Partial:
    __slots__ = ("bytes", "pieces", "total", "touched_at")

    def __init__(self, total: int, now: float) -> None:
        self.total = total
        self.pieces: dict[int, bytes] = {}
        self.bytes = 0
        self.touched_at = now


class LegacyReassembly:
    """`bytes` never exceeds `Limits.partial_bytes_per_peer`."""

    __slots__ = ("_finished", "_limits", "_partials", "bytes", "duplicates")

    def __init__(self, limits: Limits) -> None:
        self._limits = limits
        self._partials: dict[int, _Partial] = {}
        self._finished: OrderedDict[int, float] = OrderedDict()
        self.bytes = 0
        self.duplicates = 0

    def __len__(self) -> int:
        return len(self._partials)

    def add(self, piece: LegacyPayload, now: float) -> tuple[bool, PriorityMeshData | None]:
        """(whether to acknowledge, the message if this completes one); raises DecodeError for a corrupt message."""
        finished_at = self._finished.get(piece.sequence)
        if finished_at is not None:
            if now - finished_at < FINISHED_FOR_S:
                self.duplicates += 1
                return True, None
            del self._finished[piece.sequence]
        partial = self._partials.get(piece.sequence)
        if partial is not None and (partial.total != piece.total or now - partial.touched_at > PARTIAL_PATIENCE_S):
            # The number came around: these are two messages, and the older one is over.
            self._drop(piece.sequence)
            partial = None
        if partial is None:
            if piece.total * len(piece.data) > 2 * self._limits.message_bytes and piece.total > 1:
                return False, None
            if len(self._partials) >= self._limits.partials_per_peer:
                return False, None
            partial = self._partials[piece.sequence] = _Partial(piece.total, now)
        if piece.position in partial.pieces:
            self.duplicates += 1
            return True, None
        size = len(piece.data) + PIECE_OVERHEAD_BYTES
        if self.bytes + size > self._limits.partial_bytes_per_peer:
            if not partial.pieces:
                del self._partials[piece.sequence]
            return False, None
        if partial.bytes + len(piece.data) > self._limits.message_bytes:
            self._drop(piece.sequence)
            return False, None
        partial.pieces[piece.position] = piece.data
        partial.bytes += len(piece.data)
        partial.touched_at = now
        self.bytes += size
        if len(partial.pieces) < partial.total:
            return True, None
        body = b"".join([partial.pieces[position] for position in range(partial.total)])
        self._drop(piece.sequence)
        self._finished[piece.sequence] = now
        if len(self._finished) > FINISHED_REMEMBERED:
            self._finished.popitem(last=False)
        return True, decode_mesh_data(body)

    def purge(self, now: float) -> None:
        """Give up each message, by its own age, whose fragments stopped."""
        for sequence in [
            sequence for sequence, partial in self._partials.items() if now - partial.touched_at > PARTIAL_PATIENCE_S
        ]:
            self._drop(sequence)

    def _drop(self, sequence: int) -> None:
        partial = self._partials.pop(sequence)
        self.bytes -= partial.bytes + PIECE_OVERHEAD_BYTES * len(partial.pieces)
