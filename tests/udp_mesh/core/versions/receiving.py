"""Versions that reach a receiver as bodies, without a session."""

from __future__ import annotations

from udp_mesh.core.receiver.memory_limit import MemoryBudget
from udp_mesh.core.settings import Limits
from udp_mesh.core.versions.decoding import VersionDecoding
from udp_mesh.core.versions.received import CounterTable, ReceivedVersions
from udp_mesh.wire.frames import RefuseReason

TOPIC = ("map", "")


def receiver(**limits: int) -> ReceivedVersions:
    made = Limits(**limits)
    return ReceivedVersions(made, MemoryBudget(made.version_bytes), CounterTable())


def receive(versions: ReceivedVersions, body: bytes, flags: int) -> bytes | RefuseReason:
    begun = versions.begin(TOPIC, body, flags)
    if isinstance(begun, RefuseReason):
        return begun
    assert isinstance(begun, VersionDecoding)
    while not begun.step():
        pass
    return versions.finish(TOPIC, begun, len(body))
