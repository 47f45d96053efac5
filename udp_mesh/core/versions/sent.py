"""The versions that peers have, and the messages still to be encoded for them.

1. `PeerVersions.prepare` encodes a message that is next to be sent: at once, or, if it is large, in steps.
2. `SentVersions.step` does one such step and returns a message that is ready; the first step of a large base is done
   in the background. The next message of its topic to this peer waits until it is being sent, because a newer base may
   be known by then.
3. `PeerVersions.on_delivered` makes the newest acknowledged version the base of the next ones; `on_base_lost` forgets
   it.

One version per peer and topic is kept, its bytes shared by all peers that have it, and all of them stay below
`limit_bytes`. A topic is given up for a while if its differences save nothing, and never costs more than
`MAX_BYTES_PER_S` of compression.
"""

from __future__ import annotations

from collections import OrderedDict, deque
from dataclasses import replace

from udp_mesh.core.interfaces import Background
from udp_mesh.core.sender.message import AcceptedMessage, OutgoingMessage, TopicChannel
from udp_mesh.core.sender.rate_limit import TokenBucket
from udp_mesh.core.versions.conditions import VersionConditions
from udp_mesh.core.versions.encoding import MIN_BASE_BYTES, Encoded, Version, VersionEncoding, encode
from udp_mesh.core.versions.received import CounterTable
from udp_mesh.wire.frames import MessageFlag
from udp_mesh.wire.version import NO_BASE, base_of

AT_ONCE_BYTES = 1 << 16
"""Version and base of at most this size together are encoded at once, within a millisecond."""

MAX_BYTES_PER_S = 32 << 20
"""Bytes of versions and bases of one topic per second that are compared: about a tenth of a core. What exceeds it is
sent whole."""

POOR_GAIN = 0.95
"""A difference larger than this share of the whole is hardly worth its computation."""

MAX_PAUSE = 16
"""Versions sent whole between two attempts, at most, while differences save hardly anything (JPEG images)."""

SHARED_ENCODINGS, SHARED_BYTES = 4, 16 << 20
"""Encodings kept, because other peers with the same base get the same message now. The newest is kept whatever its
size."""

_COMPRESSION = MessageFlag.COMPRESSED | MessageFlag.ZSTD


class _Channel:
    """One topic to one peer."""

    __slots__ = ("base_id", "current", "failures", "pause", "topic", "waiting")

    def __init__(self, topic: TopicChannel) -> None:
        self.topic = topic
        self.base_id = -1
        """Message id of the base."""
        self.failures = 0
        self.pause = 0
        """Versions to send whole before the next attempt."""
        self.current: OutgoingMessage | None = None
        """Being encoded in steps, or encoded and not sent yet."""
        self.waiting: deque[OutgoingMessage] = deque()


class PeerVersions:
    """The versions that one peer has, by topic."""

    __slots__ = ("_channels", "_epoch", "_node", "name")

    def __init__(self, name: str, node: SentVersions) -> None:
        self.name = name
        self._node = node
        self._epoch = -1
        self._channels: dict[int, _Channel] = {}

    def prepare(self, message: OutgoingMessage, epoch: int, now: float) -> bool:
        """See `OutgoingVersion.prepare`."""
        if epoch != self._epoch:
            # Another boot of the peer: it has nothing.
            self.forget()
            self._epoch = epoch
        accepted = message.accepted
        channel = self._channels.setdefault(accepted.channel.number, _Channel(accepted.channel))
        current = channel.current
        if current is not None and not channel.waiting and (current.ended or current.started):
            channel.current = None
        if channel.current is not None:
            if message is not channel.current and message not in channel.waiting:
                channel.waiting.append(message)
                self._node.blocked[self, accepted.channel.number] = channel
            return message.version is not None and message.version.prepared
        base = self._choose_base(channel, message, now)
        size = len(accepted.payload) + (0 if base is None else len(base.payload))
        shared = self._node.shared(accepted, base)
        if shared is None and size > AT_ONCE_BYTES:
            encoding = VersionEncoding(
                accepted.payload, base, compression=self._compresses(accepted), background=self._node.background
            )
            channel.current = message
            self._node.jobs.append((self, channel, message, base, encoding))
            return False
        self.apply(
            channel, message, base, shared or self._node.encode(accepted, base, compression=self._compresses(accepted))
        )
        return True

    def _compresses(self, accepted: AcceptedMessage) -> bool:
        """Whether a whole version is compressed: the first one always, because it is the largest of all."""
        topic = accepted.channel
        return topic.topic.compression or self._node.base(self, topic.number) is None

    def apply(self, channel: _Channel, message: OutgoingMessage, base: Version | None, encoded: Encoded) -> None:
        """Send the message like this, and learn from the gain."""
        version = message.version
        assert version is not None
        message.body = encoded.body
        message.flags = message.accepted.flags & ~_COMPRESSION | encoded.flags
        version.digest, version.is_difference, version.prepared = encoded.digest, encoded.is_difference, True
        counters = self._node.counters.of(message.accepted.channel.name)
        size = len(message.accepted.payload)
        counters.payload_bytes_sent += size
        counters.body_bytes_sent += len(encoded.body)
        if encoded.is_difference:
            counters.differences_sent += 1
        else:
            counters.whole_sent += 1
        if base is not None:
            if encoded.is_difference and len(encoded.body) < POOR_GAIN * size:
                channel.failures = 0
            else:
                channel.pause = min(MAX_PAUSE, 1 << channel.failures) - 1
                channel.failures = min(channel.failures + 1, MAX_PAUSE.bit_length())

    def on_delivered(self, message: OutgoingMessage, digest: bytes) -> None:
        """The peer has this version."""
        accepted = message.accepted
        channel = self._channels.get(accepted.channel.number)
        if channel is None or accepted.message_id <= channel.base_id:
            return
        channel.base_id = accepted.message_id
        if MIN_BASE_BYTES <= len(accepted.payload) <= accepted.channel.topic.delta_bytes and base_of(digest) != NO_BASE:
            self._node.keep(self, accepted.channel.number, Version(digest, accepted.payload))
        else:
            self._node.drop(self, accepted.channel.number)

    def on_base_lost(self, topic: TopicChannel) -> None:
        """The peer does not have the base any more."""
        self._node.counters.of(topic.name).bases_lost += 1
        self._node.drop(self, topic.number)

    def on_best_effort_refused(self) -> None:
        """The peer could not decode a message that already ended, which only best-effort ones do: forget their bases.
        The message itself is not remembered."""
        for number, channel in self._channels.items():
            if not channel.topic.topic.reliable and self._node.base(self, number) is not None:
                self.on_base_lost(channel.topic)

    def forget(self) -> None:
        """Forget everything about the peer."""
        for number, channel in self._channels.items():
            self._node.drop(self, number)
            self._node.blocked.pop((self, number), None)
            # A message that waits is restarted, or comes again when its level is rebuilt.
            channel.waiting.clear()
        self._channels.clear()

    def _choose_base(self, channel: _Channel, message: OutgoingMessage, now: float) -> Version | None:
        topic = message.accepted.channel.topic
        size = len(message.accepted.payload)
        base = self._node.base(self, message.accepted.channel.number)
        version = message.version
        if base is None or (version is not None and version.whole):
            return None
        if self._node.shared(message.accepted, base) is not None:
            return base
        paused = channel.pause > 0
        channel.pause -= paused
        if paused or size > topic.delta_bytes or not self._node.afford(topic.name, size + len(base.payload), now):
            self._node.counters.of(topic.name).not_tried += 1
            return None
        return base


class SentVersions:
    """The versions of all peers of a node, and the messages being encoded."""

    def __init__(self, limit_bytes: int, counters: CounterTable, background: Background) -> None:
        self.limit_bytes = limit_bytes
        self.background = background
        self.counters = counters
        self.bytes = 0
        self.jobs: deque[tuple[PeerVersions, _Channel, OutgoingMessage, Version | None, VersionEncoding]] = deque()
        self.blocked: dict[tuple[PeerVersions, int], _Channel] = {}
        """Topics of peers with messages that wait for an earlier one."""
        self._peers: dict[str, PeerVersions] = {}
        self._bases: OrderedDict[tuple[PeerVersions, int], Version] = OrderedDict()
        """By peer and topic, the least recently used first."""
        self._users: dict[bytes, int] = {}
        """How many of `_bases` are the version with this hash."""
        self._payloads: dict[bytes, Version] = {}
        self._shared: OrderedDict[tuple[int, bytes], Encoded] = OrderedDict()
        self._shared_bytes = 0
        self._budgets: dict[str, TokenBucket] = {}
        """Bytes of each topic that may be compared now; the first versions of a mission may take a second's worth."""

    def of(self, peer: str) -> PeerVersions:
        """The versions of a peer."""
        versions = self._peers.get(peer)
        if versions is None:
            versions = self._peers[peer] = PeerVersions(peer, self)
        return versions

    def conditions(self) -> tuple[VersionConditions, ...]:
        """A snapshot of each topic."""
        topics = sorted(self.counters.topics.items())
        return tuple(VersionConditions(name, replace(counters)) for name, counters in topics)

    # Encoding

    @property
    def has_work(self) -> bool:
        """Whether `step` would do something: encodings whose base is being indexed in the background wait."""
        return any(not job[4].is_waiting for job in self.jobs)

    def step(self) -> tuple[str, OutgoingMessage] | None:
        """Do one step of the most urgent encoding that has one to do. Returns a peer and its message that is ready."""
        job = min((job for job in self.jobs if not job[4].is_waiting), key=lambda job: job[2].priority)
        versions, channel, message, base, encoding = job
        if message.ended:
            self.jobs.remove(job)
            return None
        if not encoding.step():
            return None
        self.jobs.remove(job)
        assert encoding.result is not None
        self._share(message.accepted, base, encoding.result)
        versions.apply(channel, message, base, encoding.result)
        return versions.name, message

    def unblock(self) -> list[tuple[str, OutgoingMessage]]:
        """Peers and messages whose turn it is to be prepared: the earlier one of their topic is being sent."""
        freed = []
        for (versions, number), channel in list(self.blocked.items()):
            current = channel.current
            if current is not None and not current.ended and not current.started:
                continue
            channel.current = None
            while channel.waiting and channel.waiting[0].ended:
                channel.waiting.popleft()
            if channel.waiting:
                freed.append((versions.name, channel.waiting.popleft()))
            if not channel.waiting:
                del self.blocked[versions, number]
        return freed

    def encode(self, accepted: AcceptedMessage, base: Version | None, *, compression: bool) -> Encoded:
        """Encode a small message at once."""
        encoded = encode(accepted.payload, base, compression=compression)
        self._share(accepted, base, encoded)
        return encoded

    def shared(self, accepted: AcceptedMessage, base: Version | None) -> Encoded | None:
        """The encoding of the same message for another peer with the same base."""
        return self._shared.get((accepted.message_id, b"" if base is None else base.digest))

    def _share(self, accepted: AcceptedMessage, base: Version | None, encoded: Encoded) -> None:
        key = (accepted.message_id, b"" if base is None else base.digest)
        if key in self._shared:
            return
        self._shared[key] = encoded
        self._shared_bytes += len(encoded.body)
        while len(self._shared) > SHARED_ENCODINGS or (self._shared_bytes > SHARED_BYTES and len(self._shared) > 1):
            _, oldest = self._shared.popitem(last=False)
            self._shared_bytes -= len(oldest.body)

    def afford(self, topic: str, size: int, now: float) -> bool:
        """Whether the topic may compare so many bytes now."""
        budget = self._budgets.get(topic)
        if budget is None:
            budget = self._budgets[topic] = TokenBucket(MAX_BYTES_PER_S, now, burst_s=1.0)
        has_tokens = budget.has_tokens(now)
        if has_tokens:
            budget.consume(size)
        return has_tokens

    # Bases

    def base(self, peer: PeerVersions, number: int) -> Version | None:
        key = (peer, number)
        version = self._bases.get(key)
        if version is not None:
            self._bases.move_to_end(key)
        return version

    def keep(self, peer: PeerVersions, number: int, version: Version) -> None:
        """Make this the peer's newest version of the topic; the least recently used ones make room."""
        self.drop(peer, number)
        version = self._payloads.setdefault(version.digest, version)
        users = self._users.get(version.digest, 0)
        if not users:
            self.bytes += version.kept_bytes
        self._users[version.digest] = users + 1
        self._bases[peer, number] = version
        while self.bytes > self.limit_bytes and self._bases:
            self.drop(*next(iter(self._bases)))

    def drop(self, peer: PeerVersions, number: int) -> None:
        version = self._bases.pop((peer, number), None)
        if version is None:
            return
        self._users[version.digest] -= 1
        if not self._users[version.digest]:
            del self._users[version.digest], self._payloads[version.digest]
            self.bytes -= version.kept_bytes
