"""A team of real daemons on a hostile network, and what their programs were promised.

It runs as root of a network and mount namespace of its own (`promises`). Each robot has a network namespace with one
interface, or two, whose other end is a port of an `Ether`, and a small disk of its own. A robot with the legacy program
may be among them.
"""

from __future__ import annotations

import contextlib
import random
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

from tests.udp_mesh.daemon.live.ether import Ether
from tests.udp_mesh.daemon.live.legacy import NAME as LEGACY
from tests.udp_mesh.daemon.live.legacy import LegacyRobot
from tests.udp_mesh.daemon.live.programs import Broken, Reader, Sent, Writer
from tests.udp_mesh.daemon.live.radio import run
from tests.udp_mesh.daemon.live.robot import BEST_EFFORT, LOG_READERS, NEVER_EXPIRE, OUTBOXES, PASSED_ON_S, Robot
from tests.udp_mesh.daemon.processes import KEY, OTHER_KEY
from udp_mesh.client import MeshError


class LiveTeam:
    """Robots a, b, c ..; what was sent and what came. Use as a context."""

    def __init__(self, seed: int, size: int | None = None, version: Path | None = None) -> None:
        """`version` is a checkout of another version, which one of the robots runs."""
        self.dice = random.Random(seed)
        self.size = size or self.dice.choice((2, 3, 3, 4, 4, 6))
        self.ipv6 = self.dice.random() < 0.25
        radios = 2 if self.dice.random() < 0.4 else 1
        self.ethers = [Ether(seed + number) for number in range(radios)]
        """One for the first interface of each robot, and maybe one for its second."""
        self.legacy: LegacyRobot | None = None
        self._version = version
        self.names = [chr(ord("a") + place) if place < 26 else f"r{place}" for place in range(self.size)]
        self.robots: dict[str, Robot] = {}
        self.others: list[Robot] = []
        """Robots of another fleet, and with a name that another one has."""
        self.sent: dict[bytes, Sent] = {}
        self.received: dict[str, set[bytes]] = {name: set() for name in self.names}
        self.copies: dict[str, Counter[tuple[int, bytes]]] = {name: Counter() for name in self.names}
        """By robot: (run of its daemon, key)."""
        self.readers: list[Reader] = []
        self.excused: set[tuple[str, bytes]] = set()
        """(receiver, key): sent again after a reader that had not acknowledged it left."""
        self.contested: set[str] = set()
        """Names that another robot had as well at some time."""
        self.disk_trouble: set[str] = set()
        """Robots whose disk was full at some time."""
        self.latencies: dict[str, list[float]] = {}
        self.outcomes: Counter[str] = Counter()
        self.refused: Counter[str] = Counter()
        self.changes: list[str] = []
        self.kinds: tuple[str, ...] = ()
        """Kinds of changes (none: all)."""
        self._serial = 0
        self._later: list[tuple[float, Callable[[], None]]] = []
        self._stack = contextlib.ExitStack()

    def __enter__(self) -> LiveTeam:
        with contextlib.ExitStack() as undo:
            undo.callback(self._stack.close)
            self._begin()
            undo.pop_all()
        return self

    def _begin(self) -> None:
        folder = Path(self._stack.enter_context(tempfile.TemporaryDirectory(prefix="live-", dir="/tmp")))
        self.folder = folder
        run(f"mount -t tmpfs none {folder}")
        self._stack.callback(run, f"umount -l {folder}")
        for ether in self.ethers:
            ether.start()
            self._stack.callback(ether.close)
        if not self.ipv6 and self.dice.random() < 0.4:
            self._add_legacy()
        other_version = self.dice.choice(self.names)
        for name in self.names:
            self._add(name, version=self._version if name == other_version else None)
        for name in self.names:
            self.open_reader(name)
            self.open_writer(name)

    def _add_legacy(self) -> None:
        # Its place is beyond those of robots that are added later.
        self.legacy = LegacyRobot(60, self.ethers[0], self.folder)
        self._stack.callback(self.legacy.close)
        self.legacy.start()
        self.received[LEGACY] = set()
        self.ethers[0].unsealed.add(LEGACY)

    @property
    def everyone(self) -> list[str]:
        """The robots, and the legacy one."""
        return self.names if self.legacy is None else [*self.names, LEGACY]

    def _add(self, name: str, *, key: str = KEY, called: str = "", version: Path | None = None) -> Robot:
        place = len(self.robots) + len(self.others)
        more = "" if self.legacy is None else self.legacy.neighbour
        robot = Robot(
            self.folder,
            name,
            place,
            self.ethers,
            ipv6=self.ipv6,
            key=key,
            called=called,
            version=version,
            more=more,
        )
        self._stack.callback(robot.close)
        robot.attach()
        if self.dice.random() < 0.15:
            robot.daemon.environment["SMALL_BUFFERS"] = "1"
        if name in self.names:
            self.robots[name] = robot
            if self.dice.random() < 0.1:
                self.disk_trouble.add(name)
                robot.fill_disk()
                self.later(self.dice.choice((1.0, 15.0)), robot.free_disk)
        else:
            self.others.append(robot)
        robot.start()
        return robot

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    # Programs

    def open_reader(self, name: str) -> None:
        robot = self.robots[name]
        if robot.running and robot.reader is None:
            acknowledges = self.dice.random() < 0.5
            with contextlib.suppress(MeshError):
                robot.reader = Reader(str(robot.daemon.socket), robot.runs, self.dice, acknowledges=acknowledges)
                self.readers.append(robot.reader)

    def close_reader(self, name: str) -> None:
        robot = self.robots[name]
        if robot.reader is not None:
            # what is in the socket of a program without receipts counts as taken, also while it pauses
            robot.reader.paused_until = 0.0
            self._read(name, robot)
            robot.reader.close()
            self.excused |= {(name, key) for key in robot.reader.unacknowledged}
            robot.reader = None

    def open_writer(self, name: str) -> None:
        robot = self.robots[name]
        if robot.running and robot.writer is None:
            with contextlib.suppress(MeshError):
                robot.writer = Writer(str(robot.daemon.socket), robot.runs)

    def close_writer(self, name: str) -> None:
        robot = self.robots[name]
        if robot.writer is not None:
            robot.writer.close()
            robot.writer = None

    def end(self, name: str, *, politely: bool) -> None:
        """End a robot's daemon, and its programs before it."""
        self.close_reader(name)
        self.close_writer(name)
        self.robots[name].end(politely=politely)

    def publish(self, name: str, topic: str, to: str | None, size: int) -> None:
        robot = self.robots[name]
        if robot.writer is None or not robot.running:
            return
        self._serial += 1
        key = f"{name} {robot.runs} {self._serial}".encode()
        sent = self.sent[key] = Sent(name, robot.runs, topic, key, to, size, time.monotonic())
        robot.writer.publish(sent)

    def publish_legacy(self, topic: str, to: str | None, size: int) -> None:
        """The legacy robot sends a message, of whose outcome it hears nothing."""
        assert self.legacy is not None
        self._serial += 1
        key = f"{LEGACY} {self.legacy.runs} {self._serial}".encode()
        sent = self.sent[key] = Sent(LEGACY, self.legacy.runs, topic, key, to, size, time.monotonic())
        self.legacy.send(sent)

    # Time

    def later(self, after_s: float, action: Callable[[], None]) -> None:
        self._later.append((time.monotonic() + after_s, action))

    def go(self, seconds: float, until: Callable[[], bool] | None = None) -> bool:
        """Poll the programs for so long, or until something is so."""
        end, look_at = time.monotonic() + seconds, 0.0
        while True:
            self._poll()
            now = time.monotonic()
            if until is not None and now >= look_at:
                if until():
                    return True
                look_at = time.monotonic() + 0.2
            if now >= end:
                return False
            time.sleep(0.01)

    def _poll(self) -> None:
        for ether in self.ethers:
            if ether.failure is not None:
                raise ether.failure
        now = time.monotonic()
        due = [action for at, action in self._later if at <= now]
        self._later = [(at, action) for at, action in self._later if at > now]
        for action in due:
            action()
        for robot in [*self.robots.values(), *self.others]:
            if robot.daemon.process is not None and (code := robot.daemon.process.poll()) is not None:
                raise Broken(f"{robot.name} ended by itself with {code}: {robot.daemon.log.read_text()[-3000:]}")
        for name, robot in self.robots.items():
            self._read(name, robot)
            if robot.writer is not None:
                for sent, header in robot.writer.poll():
                    self._on_outcome(sent, header)
        for taken in self.legacy.poll() if self.legacy is not None else ():
            known = self.sent.get(taken.key)
            if known is None or (known.source, known.topic) != (taken.source, taken.topic):
                raise Broken(f"the legacy robot received {taken}, which was {known}")
            self.received[LEGACY].add(taken.key)

    def _read(self, name: str, robot: Robot) -> None:
        for header, key in robot.reader.poll() if robot.reader is not None else ():
            self._on_message(name, robot, header, key)

    def _on_message(self, name: str, robot: Robot, header: dict[str, object], key: bytes) -> None:
        sent = self.sent.get(key)
        if sent is None or sent.topic != header["topic"] or sent.source != header["source"]:
            raise Broken(f"{name} received {header} with {key!r}, which was {sent}")
        assert robot.reader is not None
        self.received[name].add(key)
        self.copies[name][robot.runs, key] += 1
        if self.copies[name][robot.runs, key] < 2:
            return
        again = sent.topic == "stored" and (sent.abandoned or self.robots[sent.source].runs != sent.run)
        narrowed = any((sent.source, name) in ether.too_long for ether in self.ethers)
        held = sent.to is None and sent.topic in OUTBOXES
        # What another robot of this name had not acknowledged was sent to this one again.
        troubled = name in self.disk_trouble or name in self.contested
        known = (name, key) in self.excused or again or narrowed or held or troubled
        if not known:
            raise Broken(f"{name} received {sent} twice, the second time with {header}")

    def _on_outcome(self, sent: Sent, header: dict[str, object]) -> None:
        peer, outcome = str(header["peer"]), str(header["outcome"])
        said = outcome if outcome != "expired" else f"expired: {header['reason']}"
        self.outcomes[said] += 1
        if peer in sent.ends:
            raise Broken(f"{sent} ended again: {header}")
        if sent.to is not None and peer != sent.to:
            raise Broken(f"{sent} ended at {peer}: {header}")
        sent.ends[peer] = said
        sent.ended_at = time.monotonic()
        if said in ("expired: refused", "expired: disk") or (
            outcome == "expired" and sent.topic in NEVER_EXPIRE and "not wanted" not in said
        ):
            raise Broken(f"{sent}: {header}")
        if outcome == "delivered":
            self.latencies.setdefault(sent.topic, []).append(float(str(header["latency_s"])))
            reader = self.robots[peer].reader if peer in self.robots else None
            if reader is not None and reader.since < sent.at:
                sent.readers.append((peer, reader, time.monotonic()))

    # What must hold in the end

    def unfinished(self) -> list[Sent]:
        """Accepted reliable messages to one peer without an outcome, and durable ones that did not arrive."""
        return [
            sent
            for sent in self.sent.values()
            if sent.accepted_at is not None
            and sent.to is not None
            and not self._spans_legacy_runs(sent)
            and (
                (not sent.abandoned and not sent.ends and sent.topic not in BEST_EFFORT)
                or (self.is_durable(sent) and sent.key not in self.received[sent.to])
            )
        ]

    def missing_items(self) -> list[str]:
        """Items of the log that a reader has not got."""
        troubled = self.disk_trouble | self.contested
        return [
            f"{sent} at {reader}"
            for sent in self.sent.values()
            for reader in LOG_READERS
            if sent.topic == "artifact"
            and sent.accepted_at is not None
            and reader in self.names
            and sent.source != reader
            and not {sent.source, reader} & troubled
            and sent.key not in self.received[reader]
        ]

    def is_durable(self, sent: Sent) -> bool:
        """Whether a message has to arrive whatever ends."""
        said = sent.ends.get(sent.to or "", "delivered")
        return (
            sent.topic == "stored"
            and sent.accepted_at is not None
            and said == "delivered"
            and sent.to not in self.contested
            and (sent.source not in self.disk_trouble or bool(sent.ends))
        )

    def _spans_legacy_runs(self, sent: Sent) -> bool:
        """Whether one run of the legacy program may have acknowledged a part of this message, and the next one the
        rest."""
        if self.legacy is None or sent.to not in (LEGACY, None) or sent.ends.get(LEGACY) != "delivered":
            return False
        assert sent.ended_at is not None
        return any(sent.at <= at <= sent.ended_at for at in self.legacy.restarted_at)

    def lost_at_legacy(self) -> list[Sent]:
        """What was reported as delivered to the legacy robot but has not reached its programs."""
        return [
            sent
            for sent in self.sent.values()
            if sent.ends.get(LEGACY) == "delivered"
            and sent.key not in self.received[LEGACY]
            and not self._spans_legacy_runs(sent)
        ]

    def not_passed_on(self) -> list[Sent]:
        """What was reported as delivered but has not reached a program that was subscribed there and stayed."""
        return [
            sent
            for sent in self.sent.values()
            for peer, reader, at in sent.readers
            if sent.key not in reader.keys
            and not reader.dropped
            and peer not in self.contested
            and (reader.ended_at is None or reader.ended_at > max(at, reader.paused_until) + PASSED_ON_S)
        ]

    def add_stranger(self) -> None:
        """A robot of another fleet with the same names of topics."""
        self._add(f"x{len(self.others)}", key=OTHER_KEY)

    def add_twin(self, name: str) -> Robot:
        """A robot that has another one's name."""
        self.contested.add(name)
        return self._add(f"t{len(self.others)}", called=name)
