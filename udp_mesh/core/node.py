"""A node: bytes and the time in; datagrams, events and one timer out. It never waits, reads no clock and opens nothing.

A driver repeats: `receive` what arrived, `handle_timer` when `next_timer` has come, then `datagrams_to_send` until it
returns none, then `next_event` until None.
"""

from udp_mesh.core import publish, reconfigure, survey, transmit
from udp_mesh.core.conditions import Conditions
from udp_mesh.core.events import Event, MessageId, Rejected
from udp_mesh.core.interfaces import Datagram, RandomSource, Store
from udp_mesh.core.legacy.peers import LegacyPeers
from udp_mesh.core.receive import receive_datagram
from udp_mesh.core.settings import Address, LinkInfo, Settings
from udp_mesh.core.state import State
from udp_mesh.wire.header import MARK
from udp_mesh.wire.legacy import decapsulate
from udp_mesh.wire.limits import BOOT_ID_BYTES


class Node:
    """One run of one named node. `boot_id` (16 random bytes, never used before) tells this run from all others."""

    def __init__(
        self, settings: Settings, *, boot_id: bytes, rng: RandomSource, now: float, store: Store | None = None
    ) -> None:
        """`now` is seconds on any clock that never runs backwards. `store` holds outboxes on disk (None: in memory)."""
        if len(boot_id) != BOOT_ID_BYTES:
            raise ValueError(f"boot_id: expected {BOOT_ID_BYTES} bytes, found {len(boot_id)}")
        self._state = State(settings, boot_id, rng, now, store)
        self._legacy = LegacyPeers(self._state)
        reconfigure.restore_outboxes(self._state, now)

    @property
    def settings(self) -> Settings:
        """The settings in force."""
        return self._state.settings

    def receive(self, data: bytes | memoryview, link: str, source: Address, now: float) -> None:
        """Take in one datagram. Bad bytes are counted and dropped; this never raises because of what was received."""
        if len(data) and data[0] < MARK:
            covered = decapsulate(data)
            if covered is not None:
                data = covered
        if len(data) and data[0] < MARK and self._legacy:
            self._legacy.receive(data, link, source, now)
        else:
            receive_datagram(self._state, data, link, source, now)

    def datagrams_to_send(self, now: float, *, max_bytes: int | None = None) -> list[Datagram]:
        """The datagrams that leave now, most urgent first, about 64 KiB at most per call (`max_bytes`, if given).

        Call again while it `has_datagrams`. With `max_bytes` a driver whose socket is full asks for less.
        """
        out = transmit.collect(self._state, now, max_bytes)
        if self._legacy:
            out = self._legacy.encapsulate_broadcasts(out)
            self._legacy.send(now, out)
        if out:
            transmit.count_sent(self._state, out)
        return out

    def next_timer(self) -> float | None:
        """When `handle_timer` wants to be called next (None: never). Cheap; may be in the past."""
        at = transmit.next_timer(self._state)
        if self._legacy and at is not None:
            return min(at, self._legacy.next_at())
        return at

    def handle_timer(self, now: float) -> None:
        """Do what is due at `now`. Calling early or late is harmless."""
        transmit.handle_timer(self._state, now)
        if self._legacy:
            self._legacy.handle_timer(now)

    @property
    def has_datagrams(self) -> bool:
        """Whether `datagrams_to_send` may return something; False right after it returned all there was."""
        return bool(self._legacy) or transmit.has_datagrams(self._state)

    @property
    def is_quiet(self) -> bool:
        """Whether nothing is to be sent or told until `next_timer`: the driver may leave the node alone.

        True after most datagrams of a bulk, of which only every few ask for an answer.
        """
        return not self._legacy and transmit.is_quiet(self._state)

    def next_event(self) -> Event | None:
        """The oldest event not yet fetched."""
        return self._state.event_queue.next_event()

    def send(
        self, topic: str, payload: bytes, *, destination: str | None = None, now: float, type_name: str = ""
    ) -> MessageId | Rejected:
        """Accept a message for one peer, or (None) for the topic's destinations, or for all.

        Per destination of a reliable topic exactly one outcome event follows. A message to all that fits one datagram
        is broadcast and has no outcome. A peer never heard of is `UNKNOWN_PEER` unless an outbox may hold the message.
        """
        return publish.send(self._state, topic, payload, destination, type_name, now)

    def link_up(self, link: LinkInfo, now: float) -> None:
        """A network attachment appeared, or changed its addresses or MTU (same name)."""
        reconfigure.link_up(self._state, link, now)

    def link_down(self, name: str, now: float) -> None:
        """The attachment is gone; peers reached over it are reached over others as they are heard there."""
        reconfigure.link_down(self._state, name)

    def apply(self, settings: Settings, now: float) -> list[str]:
        """Change topics, window, rates, limits, keys and neighbours; returns one line per change made.

        Drops no accepted message. A changed name or port raises ValueError: these need a new run.
        """
        lines = reconfigure.apply(self._state, settings, now)
        self._legacy.apply()
        return lines

    def conditions(self, now: float) -> Conditions:
        """A snapshot for the autonomy, the status page and the metrics."""
        return survey.conditions(self._state, now)

    def close(self, now: float) -> None:
        """Say good-bye: fetch the last datagrams and events after it. Reliable messages still open end as expired."""
        reconfigure.close(self._state, now)
