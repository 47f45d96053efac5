"""Publishes samples from the mesh in a Zenoh network: one publisher per key and quality of service, the least recently
used undeclared first.

Each ROS 2 publisher with transient local durability has a counterpart here that caches its last samples for late
joiners, as `rmw_zenoh` does.
"""

from __future__ import annotations

from collections import OrderedDict
from typing import Any, Callable

import zenoh
import zenoh.ext

from udp_mesh.bridges.envelope import Envelope
from udp_mesh.bridges.rmw_zenoh import publisher_id

MAX_PUBLISHERS = 1024
"""Publishers of one session; a peer can invent keys without bound."""
PRIORITIES = dict(
    enumerate(
        (
            zenoh.Priority.REAL_TIME,
            zenoh.Priority.INTERACTIVE_HIGH,
            zenoh.Priority.INTERACTIVE_LOW,
            zenoh.Priority.DATA_HIGH,
            zenoh.Priority.DATA,
            zenoh.Priority.DATA_LOW,
            zenoh.Priority.BACKGROUND,
        ),
        start=1,
    )
)
"""Zenoh's priorities by number: 1 is the most urgent."""


class _PlainPublisher:
    """A publisher that numbers its samples, so that bridges can identify their session."""

    def __init__(self, session: Any, sample: Envelope) -> None:
        self._publisher = session.declare_publisher(sample.key, **_quality(sample))
        self._number = 0

    def put(self, sample: Envelope) -> None:
        self._number += 1
        source = zenoh.SourceInfo(self._publisher.id, self._number & 0xFFFFFFFF)
        if sample.delete:
            self._publisher.delete(attachment=sample.attachment, source_info=source)
        else:
            self._publisher.put(
                sample.payload, encoding=sample.encoding, attachment=sample.attachment, source_info=source
            )

    def undeclare(self) -> None:
        self._publisher.undeclare()


class _CachingPublisher:
    """A publisher that caches its last samples; with miss detection on, Zenoh numbers them itself."""

    def __init__(self, session: Any, sample: Envelope, depth: int) -> None:
        self._publisher: Any = zenoh.ext.declare_advanced_publisher(
            session,
            sample.key,
            cache=zenoh.ext.CacheConfig(depth),
            publisher_detection=True,
            sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=None),
            **_quality(sample),
        )

    def put(self, sample: Envelope) -> None:
        if sample.delete:
            self._publisher.delete(attachment=sample.attachment)
        else:
            self._publisher.put(sample.payload, encoding=sample.encoding, attachment=sample.attachment)

    def undeclare(self) -> None:
        self._publisher.undeclare()


def _quality(sample: Envelope) -> dict[str, Any]:
    control = zenoh.CongestionControl.BLOCK if sample.block else zenoh.CongestionControl.DROP
    return {"priority": PRIORITIES[sample.priority], "congestion_control": control, "express": sample.express}


class Publishers:
    """All publishers of one session. Not thread-safe."""

    def __init__(self, session: Any, depth_of: Callable[[str], int]) -> None:
        """`depth_of(key)`: number of samples that each publisher of a key caches for late joiners; 0: none."""
        self._session = session
        self._depth_of = depth_of
        self._publishers: OrderedDict[tuple[object, ...], _PlainPublisher | _CachingPublisher] = OrderedDict()

    def put(self, sample: Envelope) -> None:
        """Puts a sample under its own key. Raises zenoh.ZError."""
        depth = self._depth_of(sample.key)
        whose = publisher_id(sample.attachment) if depth else b""
        wanted = (sample.key, sample.priority, sample.block, sample.express, depth, whose)
        found = self._publishers.pop(wanted, None)
        if found is None:
            found = _CachingPublisher(self._session, sample, depth) if depth else _PlainPublisher(self._session, sample)
        self._publishers[wanted] = found
        if len(self._publishers) > MAX_PUBLISHERS:
            self._publishers.popitem(last=False)[1].undeclare()
        found.put(sample)

    def withdraw_stale(self) -> None:
        """Undeclares publishers whose key has no cache any more, or one of another depth."""
        for wanted in [
            wanted for wanted in self._publishers if wanted[4] and wanted[4] != self._depth_of(str(wanted[0]))
        ]:
            self._publishers.pop(wanted).undeclare()
