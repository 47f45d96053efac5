"""Sessions by boot id, peers by name, and the channels that a short header's tag may mean.

A newly heard boot is unverified until it proves that it hears us. Unverified sessions are few, and the oldest is
dropped first. A verified session becomes the current one of its name: the first one, a restart, or a conflict.
"""

from enum import Enum

from udp_mesh.core.peers.channel_counters import BootMemory
from udp_mesh.core.peers.session import Peer, Session
from udp_mesh.core.peers.session_state import SessionEvent, SessionState
from udp_mesh.core.receiver.memory_limit import MemoryBudget
from udp_mesh.core.sender.send_memory import SendMemory
from udp_mesh.core.settings import Settings
from udp_mesh.core.versions.received import CounterTable, ReceivedVersions
from udp_mesh.crypto import Key, ReceiveChannel

MAX_RETIRED = 16
"""Retired boots of a name still kept, to detect conflicts; of older ones only the counters are kept."""


class VerifyResult(Enum):
    """The effect of a session's verification on its name."""

    NEW = 1
    RESTARTED = 2
    OWN_NAME = 3
    RETIRED = 4
    """A retired boot of the name: a conflict while the current one is online; otherwise it becomes current again."""
    FULL = 5


class PeerTable:
    """`data_tags` and `broadcast_tags` map a short header's tag to the channels it may mean."""

    __slots__ = (
        "_boots",
        "_limits",
        "_non_current",
        "_unverified",
        "broadcast_tags",
        "data_tags",
        "memory",
        "own_boot",
        "own_name",
        "peers",
        "send_memory",
        "sessions",
        "version_counters",
        "version_memory",
    )

    def __init__(self, settings: Settings, own_boot: bytes) -> None:
        self.own_name = settings.name
        self.own_boot = own_boot
        self._limits = settings.limits
        self.sessions: dict[bytes, Session] = {}
        self.peers: dict[str, Peer] = {}
        self._unverified: dict[bytes, None] = {}
        self._non_current: dict[bytes, Session] = {}
        """Sessions that are not the current one of any peer, by boot id."""
        self._boots = BootMemory()
        self.memory = MemoryBudget(settings.limits.partial_bytes)
        self.send_memory = SendMemory(settings.limits.queue_bytes)
        """What waits to be sent, to all peers and in all outboxes."""
        self.version_memory = MemoryBudget(settings.limits.version_bytes)
        self.version_counters = CounterTable()
        self.data_tags: dict[int, list[tuple[ReceiveChannel, Session]]] = {}
        self.broadcast_tags: dict[int, list[tuple[ReceiveChannel, Session]]] = {}

    def apply(self, settings: Settings) -> None:
        self._limits = settings.limits
        self.memory.set_limit(settings.limits.partial_bytes)
        self.send_memory.limit = settings.limits.queue_bytes
        self.version_memory.set_limit(settings.limits.version_bytes)

    def get_or_create(self, name: str, settings: Settings) -> Peer | None:
        """The peer of a name, created if needed. None if there are too many."""
        peer = self.peers.get(name)
        if peer is None and len(self.peers) < self._limits.peers:
            peer = self.peers[name] = Peer(name, settings, self.send_memory)
        return peer

    def add_unverified(self, name: str, boot_id: bytes, keys: tuple[Key, ...], settings: Settings) -> Session:
        """Add a session for a newly heard boot."""
        while len(self._unverified) >= self._limits.strangers:
            self.forget(self.sessions[next(iter(self._unverified))])
        session = Session(name, boot_id, self.own_boot, keys, settings, self.memory)
        session.receiver.versions = ReceivedVersions(settings.limits, self.version_memory, self.version_counters)
        self._boots.restore(session)
        self.sessions[boot_id] = self._non_current[boot_id] = session
        self._unverified[boot_id] = None
        self._enter_tags(session)
        return session

    def verify(self, session: Session, settings: Settings) -> tuple[VerifyResult, Peer | None]:
        """Mark the session as verified. After NEW and RESTARTED the caller makes it its peer's session; `Peer.session`
        still is the old one."""
        had_name_before = session.state is SessionState.RETURNED
        session.transition(SessionEvent.VERIFIED)
        if session.name == self.own_name:
            # It stays among the unverified sessions, which are few: a key holder could invent such boots without end.
            return VerifyResult.OWN_NAME, None
        self._unverified.pop(session.boot_id, None)
        peer = self.get_or_create(session.name, settings)
        if peer is None:
            self.forget(session)
            return VerifyResult.FULL, None
        if had_name_before and peer.session is not None:
            session.peer = peer
            return VerifyResult.RETIRED, peer
        return (VerifyResult.NEW if peer.session is None else VerifyResult.RESTARTED), peer

    def replace(self, peer: Peer, session: Session) -> None:
        """Make the session the current one of its peer. The earlier one is retired but kept, to detect conflicts."""
        old = peer.session
        if old is not None:
            peer.retired[old.boot_id] = None
            if len(peer.retired) > MAX_RETIRED:
                oldest = next(iter(peer.retired))
                del peer.retired[oldest]
                if oldest in self.sessions:
                    self.forget(self.sessions[oldest])
            if old.boot_id in self.sessions:
                self._non_current[old.boot_id] = old
        peer.retired.pop(session.boot_id, None)
        peer.session = session
        session.peer = peer
        self._non_current.pop(session.boot_id, None)

    def forget(self, session: Session) -> None:
        """Drop a session and its channels; its counters are saved."""
        self._boots.save(session)
        session.receiver.close()
        self.sessions.pop(session.boot_id, None)
        self._unverified.pop(session.boot_id, None)
        self._non_current.pop(session.boot_id, None)
        for table, channels in (
            (self.data_tags, session.data_channels),
            (self.broadcast_tags, session.broadcast_channels),
        ):
            for channel in channels:
                entries = [entry for entry in table.get(channel.tag, []) if entry[1] is not session]
                if entries:
                    table[channel.tag] = entries
                else:
                    table.pop(channel.tag, None)

    def set_keys(self, keys: tuple[Key, ...]) -> None:
        """Apply new live keys to every session."""
        self.data_tags.clear()
        self.broadcast_tags.clear()
        for session in self.sessions.values():
            session.set_keys(self.own_boot, keys)
            self._enter_tags(session)

    def not_current(self) -> list[Session]:
        """Unverified sessions, and boots replaced by another one of the same name."""
        return list(self._non_current.values())

    def online(self) -> list[Peer]:
        return [peer for peer in self.peers.values() if peer.online]

    def _enter_tags(self, session: Session) -> None:
        for channel in session.data_channels:
            self.data_tags.setdefault(channel.tag, []).append((channel, session))
        for channel in session.broadcast_channels:
            self.broadcast_tags.setdefault(channel.tag, []).append((channel, session))
