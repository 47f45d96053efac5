"""What must hold of every datagram, whatever a network does with it: it takes effect at most once at each boot of a
node, only if a node sent it, and not long after that. And an address without a node is never taken for a peer's.

Messages have numbers of their own, so a replayed one does no visible harm most of the time. A replayed acknowledgment,
refusal or announcement might.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from unittest.mock import patch

from tests.udp_mesh.core.random_teams import Broken, RandomTeam
from udp_mesh.core import endpoint, receive
from udp_mesh.core.peers.session import Challenge, Session
from udp_mesh.core.receiver import replay_check
from udp_mesh.core.receiver.datagram_age import ACCEPT_AGE_S
from udp_mesh.core.receiver.replay_check import clock_of, timestamp_of
from udp_mesh.core.relaying import relaying
from udp_mesh.core.settings import Address
from udp_mesh.core.state import State
from udp_mesh.crypto import SendChannel
from udp_mesh.wire.frames import Frame
from udp_mesh.wire.header import SEAL_TAG_BYTES

MAX_AGE_S = 2 * ACCEPT_AGE_S + 5.0
"""The oldest datagram that may take effect: the first one of a boot is up to `ACCEPT_AGE_S` old, later ones are
compared with it, and windows age in steps."""
CLOCK_ERROR_S = 0.5
"""Of the age of a datagram with a timestamp: clocks are compared in milliseconds, and may drift."""


class Effects:
    """Follows the datagrams of a team."""

    def __init__(self, team: RandomTeam) -> None:
        self._team = team
        self._seen: set[tuple[bytes, bytes, int]] = set()
        """Receiver's boot, and sender's boot and packet number, or seal and no number."""
        self._least_ages_s: dict[tuple[bytes, bytes], float] = {}
        """By boots of receiver and sender, of what took effect: ages are compared with that."""
        self._sealed_at: dict[bytes, float] = {}
        """When each datagram was sealed, by its seal, which no other has."""
        self._seal = b""
        """Of the datagram being received; each datagram has another one."""

    def on_sealed(self, data: bytes) -> None:
        self._sealed_at[data[-SEAL_TAG_BYTES:]] = self._team.now

    def receiving(self, data: bytes | memoryview) -> None:
        self._seal = bytes(data[-SEAL_TAG_BYTES:])

    def on_unicast(self, state: State, session: Session, number: int) -> None:
        self._once((state.boot_id, session.boot_id, number), state, session)

    def on_broadcast(self, state: State, session: Session) -> None:
        self._once((state.boot_id, self._seal, -1), state, session)

    def check_age(self, state: State, session: Session, *, timestamped: bool) -> None:
        sent_at = self._sealed_at.get(self._seal)
        if sent_at is None:
            raise Broken(f"a datagram that no node sent took effect at {state.settings.name} as from {session.name}")
        age_s, boots = self._team.arrived_at - sent_at, (state.boot_id, session.boot_id)
        least_s = self._least_ages_s[boots] = min(age_s, self._least_ages_s.get(boots, age_s))
        if age_s > (least_s + ACCEPT_AGE_S + CLOCK_ERROR_S if timestamped else MAX_AGE_S) or age_s > MAX_AGE_S:
            raise Broken(f"a datagram from {session.name} took effect at {state.settings.name} {age_s:.1f} s later")

    def on_path_validated(self, state: State, session: Session, challenge: Challenge) -> None:
        network = self._team.networks.get(challenge.link)
        if network is not None and challenge.address not in [network.address(member) for member in network.members]:
            raise Broken(f"{state.settings.name} takes {challenge.address} for an address of {session.name}")

    def _once(self, key: tuple[bytes, bytes, int], state: State, session: Session) -> None:
        if key in self._seen:
            raise Broken(f"a datagram from {session.name} took effect at {state.settings.name} twice")
        self._seen.add(key)


@contextmanager
def effects_watched(team: RandomTeam) -> Iterator[None]:
    """Fails when a datagram takes effect that must not. Those that wait for the proof of a first contact take effect
    while another one is received."""
    effects, released = Effects(team), False
    seal_run, seal_long = SendChannel.seal_run, SendChannel.seal_long
    receive_datagram, process_frames = endpoint.receive_datagram, receive.process_frames  # type: ignore[attr-defined]
    on_path_validated = replay_check.on_path_validated  # type: ignore[attr-defined]
    release_held, receive_broadcast = receive._release_held, receive._receive_broadcast

    def sealed_run(channel: SendChannel, run: Sequence[bytes | bytearray | memoryview]) -> list[bytes]:
        found = seal_run(channel, run)
        for data in found:
            effects.on_sealed(data)
        return found

    def sealed_long(channel: SendChannel, frames: bytes | bytearray | memoryview) -> tuple[int, bytes]:
        number, data = seal_long(channel, frames)
        effects.on_sealed(data)
        return number, data

    def received(state: State, data: bytes | memoryview, link: str, source: Address, now: float) -> None:
        effects.receiving(data)
        receive_datagram(state, data, link, source, now)

    def processed(
        state: State,
        session: Session,
        frames: list[Frame],
        number: int,
        link: str,
        source: Address,
        now: float,
        late_s: float = 0.0,
    ) -> None:
        effects.on_unicast(state, session, number)
        if not released:
            effects.check_age(state, session, timestamped=clock_of(frames) is not None)
        process_frames(state, session, frames, number, link, source, now, late_s)

    def releases(state: State, session: Session, now: float) -> None:
        nonlocal released
        released = True
        release_held(state, session, now)
        released = False

    def broadcast(
        state: State, session: Session, number: int, frames: bytes, link: str, source: Address, now: float
    ) -> None:
        counters = state.event_queue.counters
        before = counters.dropped_unproven + counters.dropped_malformed + counters.dropped_stale
        receive_broadcast(state, session, number, frames, link, source, now)
        if counters.dropped_unproven + counters.dropped_malformed + counters.dropped_stale == before:
            effects.on_broadcast(state, session)
            effects.check_age(state, session, timestamped=timestamp_of(frames) is not None)

    def validated(state: State, session: Session, challenge: Challenge, now: float) -> None:
        effects.on_path_validated(state, session, challenge)
        on_path_validated(state, session, challenge, now)

    with (
        patch.object(replay_check, "on_path_validated", validated),
        patch.object(SendChannel, "seal_run", sealed_run),
        patch.object(SendChannel, "seal_long", sealed_long),
        patch.object(endpoint, "receive_datagram", received),
        # What relays carried.
        patch.object(relaying, "receive_datagram", received),
        patch.object(receive, "process_frames", processed),
        patch.object(receive, "_release_held", releases),
        patch.object(receive, "_receive_broadcast", broadcast),
    ):
        yield
