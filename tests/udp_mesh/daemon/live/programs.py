"""Programs of a live team: readers and writers on a daemon's socket, polled and never waited for."""

from __future__ import annotations

import contextlib
import random
import time
from collections import Counter, deque
from dataclasses import dataclass, field

from udp_mesh.client import MeshClient, MeshError
from udp_mesh.client.mesh_client import Frame, Header


class Broken(AssertionError):
    """Something that must hold did not."""


def key_of(payload: bytes) -> bytes:
    """What names a message: source, run of its daemon and serial number. Raises Broken if it was changed."""
    key, found, filler = payload.partition(b"|")
    if not found or len(key) > 40:
        raise Broken(f"received something that nobody sent: {payload[:60]!r}")
    if payload != payload_of(key, len(payload)):
        raise Broken(f"{key!r} arrived changed: {len(payload)} B, {filler[:40]!r}")
    return key


def payload_of(key: bytes, size: int) -> bytes:
    """A payload that follows from its key and size: its first half does not compress, the second does, and versions
    of it differ in part."""
    size = max(size, len(key) + 1)
    room = size - len(key) - 1
    filler = random.Random(key + b" %d" % size).randbytes(room // 2)
    same = random.Random(size).randbytes(min(room, 4096)) if room > 4096 else b""
    return (key + b"|" + filler + same + bytes(room))[:size]


@dataclass(eq=False)
class Sent:
    """One accepted message."""

    source: str
    run: int
    topic: str
    key: bytes
    to: str | None
    size: int
    at: float
    accepted_at: float | None = None
    ends: dict[str, str] = field(default_factory=dict)
    """Outcome by peer."""
    ended_at: float | None = None
    """When the last of them came."""
    abandoned: bool = False
    """Its program or daemon ended: nobody hears of its outcome."""
    readers: list[tuple[str, Reader, float]] = field(default_factory=list)
    """Peers that it was reported as delivered to, what was subscribed there, and when that was."""

    def __str__(self) -> str:
        return f"{self.key.decode()} of {self.topic} ({self.size} B) to {self.to}, {self.ends}"


class Program(MeshClient):
    """A client whose requests are answered later."""

    def __init__(self, path: str) -> None:
        super().__init__(path, timeout_s=30.0)
        self.gone = False

    def post(self, op: str, payload: bytes = b"", **fields: object) -> int:
        """Send a request; its reply comes from `poll`."""
        number = next(self._ids)
        self._requests.add(number)
        try:
            self._write(dict(fields, op=op, id=number), payload)
        except MeshError:
            self.gone = True
        return number

    def poll(self) -> tuple[dict[int, Header], list[Frame]]:
        """Replies by request and events that are here."""
        with contextlib.suppress(MeshError):
            while not self.gone and self._read(0):
                pass
            self.gone = self.gone or self._socket.fileno() < 0
        replies = {number: frame[0] for number, frame in self._replies.items()}
        self._replies.clear()
        self._requests -= replies.keys()
        events = list(self._events)
        self._events.clear()
        return replies, events


class Reader:
    """A program that reads everything. With `acknowledges`, it acknowledges what it has processed, after a while."""

    def __init__(self, path: str, run: int, rng: random.Random, *, acknowledges: bool) -> None:
        self.run, self.acknowledges = run, acknowledges
        self.since = time.monotonic()
        self.ended_at: float | None = None
        self.paused_until = 0.0
        self.keys: Counter[bytes] = Counter()
        self.unacknowledged: set[bytes] = set()
        self.with_receipt: set[bytes] = set()
        self.dropped = 0
        self._rng = rng
        self._due: deque[tuple[float, int, bytes]] = deque()
        self.program = Program(path)
        self.program.subscribe("*", acknowledge=acknowledges)

    def poll(self) -> list[tuple[Header, bytes]]:
        """Header and key of the messages that came."""
        now = time.monotonic()
        if now < self.paused_until:
            return []
        found = []
        _, events = self.program.poll()
        for header, payload in events:
            if header["event"] == "dropped":
                self.dropped += header["messages"]
            if header["event"] != "message":
                continue
            key = key_of(payload)
            self.keys[key] += 1
            found.append((header, key))
            if (receipt := header.get("receipt")) is not None:
                self.with_receipt.add(key)
                self.unacknowledged.add(key)
                self._due.append((now + self._rng.choice((0.0, 0.02, 0.3)), receipt, key))
        receipts = []
        while self._due and self._due[0][0] <= now:
            _, receipt, key = self._due.popleft()
            receipts.append(receipt)
            self.unacknowledged.discard(key)
        if receipts:
            self.program.post("acknowledge", receipts=receipts)
        return found

    def close(self) -> None:
        self.ended_at = time.monotonic()
        self.program.close()


class Writer:
    """A program that publishes and hears of the outcomes."""

    def __init__(self, path: str, run: int) -> None:
        self.run = run
        self.program = Program(path)
        self.asked: dict[int, Sent] = {}
        self.messages: dict[int, Sent] = {}
        self.refused: Counter[str] = Counter()
        self._early: list[Header] = []
        """Outcomes that came before the reply: those of messages that wait for the disk."""

    def publish(self, sent: Sent) -> None:
        fields = {} if sent.to is None else {"to": sent.to}
        payload = payload_of(sent.key, sent.size)
        self.asked[self.program.post("publish", payload, topic=sent.topic, notify=True, **fields)] = sent

    def poll(self) -> list[tuple[Sent, Header]]:
        """Outcomes that came, with what they are of."""
        replies, events = self.program.poll()
        for number, reply in replies.items():
            sent = self.asked.pop(number, None)
            if sent is None:
                continue
            if reply.get("ok"):
                sent.accepted_at = time.monotonic()
                self.messages[reply["message"]] = sent
            else:
                self.refused[reply["code"]] += 1
        waiting = self._early + [header for header, _ in events if header["event"] == "outcome"]
        self._early = [header for header in waiting if header["message_id"] not in self.messages]
        return [
            (self.messages[header["message_id"]], header) for header in waiting if header["message_id"] in self.messages
        ]

    def finish(self) -> None:
        """Raises Broken if an outcome came of what was never accepted."""
        if self._early and not self.asked:
            raise Broken(f"outcomes of messages that nobody sent: {self._early[:3]}")

    def close(self) -> None:
        for sent in [*self.asked.values(), *self.messages.values()]:
            if not sent.ends:
                sent.abandoned = True
        self.program.close()
