"""Fragments of one legacy peer -> complete messages, each once, within a memory cap.

Unlike the legacy receiver, this one allocates nothing from numbers on the wire, remembers finished messages so that a
repeated fragment starts no new one, and drops an old partial message when its number wraps around. Numbers restart at 1
with the legacy program: the contents of a fragment, not its number alone, distinguish a repetition from a new message.
"""

import zlib
from collections import OrderedDict
from dataclasses import dataclass

from udp_mesh.core.receiver.reassembly import FRAGMENT_OVERHEAD_BYTES
from udp_mesh.core.settings import Limits
from udp_mesh.wire.legacy import LegacyPayload, PriorityMeshData, decode_mesh_data
from udp_mesh.wire.limits import MAX_LEGACY_FRAGMENT_BYTES

PARTIAL_TIMEOUT_S = 10.0
"""A message is dropped after this long without a fragment (the timeout of the legacy system)."""

FINISHED_REMEMBERED = 1024
"""Finished messages of one peer: far fewer than its 32,767 numbers, far more than its window of three."""

FINISHED_FOR_S = 30.0
"""A number finished longer ago belongs to a new message."""

REPEATED_WITHIN_S = 2.0
"""The network repeats a fragment within this time; the legacy sender never does, and takes longer to restart."""


@dataclass(frozen=True, slots=True)
class _Finished:
    """Distinguishes a repeated fragment of a finished message from the first one of a new message with the same
    number."""

    at: float
    total: int
    first_crc32: int

    def repeats(self, fragment: LegacyPayload, now: float) -> bool:
        if fragment.total != self.total or now - self.at >= FINISHED_FOR_S:
            return False
        if fragment.position == 0:
            return zlib.crc32(fragment.data) == self.first_crc32
        return now - self.at < REPEATED_WITHIN_S


class _LegacyPartial:
    __slots__ = ("bytes", "payloads", "total", "touched_at")

    def __init__(self, total: int, now: float) -> None:
        self.total = total
        self.payloads: dict[int, bytes] = {}
        self.bytes = 0
        self.touched_at = now


class LegacyReassembly:
    """`bytes` never exceeds `Limits.partial_bytes_per_peer`."""

    __slots__ = ("_finished", "_limits", "_partials", "bytes", "duplicates", "over_limit")

    def __init__(self, limits: Limits) -> None:
        self._limits = limits
        self._partials: dict[int, _LegacyPartial] = {}
        self._finished: OrderedDict[int, _Finished] = OrderedDict()
        self.bytes = 0
        self.duplicates = 0
        self.over_limit = 0
        """Fragments of messages larger than the limit."""

    def __len__(self) -> int:
        return len(self._partials)

    def add(self, fragment: LegacyPayload, now: float) -> tuple[bool, PriorityMeshData | None]:
        """Returns (whether to acknowledge, the completed message if any). Raises DecodeError for a corrupt message."""
        finished = self._finished.get(fragment.sequence)
        if finished is not None:
            if finished.repeats(fragment, now):
                self.duplicates += 1
                return True, None
            del self._finished[fragment.sequence]
        partial = self._partials.get(fragment.sequence)
        if partial is not None and (
            partial.total != fragment.total
            or now - partial.touched_at > PARTIAL_TIMEOUT_S
            or partial.payloads.get(fragment.position, fragment.data) != fragment.data
        ):
            # The number wrapped around, or the sender restarted: this is a new message, and the older one is over.
            self._drop(fragment.sequence)
            partial = None
        if (fragment.total - 1) * MAX_LEGACY_FRAGMENT_BYTES > self._limits.message_bytes:
            # Acknowledged anyway: without an answer the legacy sender assumes a lost peer and drops everything.
            self.over_limit += 1
            return True, None
        if partial is None:
            if len(self._partials) >= self._limits.partials_per_peer:
                return False, None
            partial = self._partials[fragment.sequence] = _LegacyPartial(fragment.total, now)
        if fragment.position in partial.payloads:
            self.duplicates += 1
            return True, None
        size = len(fragment.data) + FRAGMENT_OVERHEAD_BYTES
        if self.bytes + size > self._limits.partial_bytes_per_peer:
            if not partial.payloads:
                del self._partials[fragment.sequence]
            return False, None
        partial.payloads[fragment.position] = fragment.data
        partial.bytes += len(fragment.data)
        partial.touched_at = now
        self.bytes += size
        if len(partial.payloads) < partial.total:
            return True, None
        body = b"".join([partial.payloads[position] for position in range(partial.total)])
        self._finished[fragment.sequence] = _Finished(now, partial.total, zlib.crc32(partial.payloads[0]))
        self._finished.move_to_end(fragment.sequence)
        self._drop(fragment.sequence)
        if len(self._finished) > FINISHED_REMEMBERED:
            self._finished.popitem(last=False)
        return True, decode_mesh_data(body)

    def purge(self, now: float) -> None:
        """Drop each message that received no fragment for too long."""
        for sequence in [
            sequence for sequence, partial in self._partials.items() if now - partial.touched_at > PARTIAL_TIMEOUT_S
        ]:
            self._drop(sequence)

    def _drop(self, sequence: int) -> None:
        partial = self._partials.pop(sequence)
        self.bytes -= partial.bytes + FRAGMENT_OVERHEAD_BYTES * len(partial.payloads)
