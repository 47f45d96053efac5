"""A team of real transport cores on a simulated channel: traffic in, events out.

`Team` gives each robot a `udp_mesh.core.Endpoint` and connects them with a `Medium`. Every input to a node (a datagram,
its timer, a message of the scenario) is followed by `_pump`, which fetches its datagrams, its events and its next
timer. Events go to `on_event`; `Ledger` accounts for reliable messages.
"""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial

from udp_mesh.core.conditions import Conditions
from udp_mesh.core.endpoint import Endpoint
from udp_mesh.core.events import (
    Event,
    MessageDelivered,
    MessageExpired,
    MessageId,
    MessagePeerLost,
    Rejected,
)
from udp_mesh.core.logs.store import MemoryLogStore
from udp_mesh.core.settings import LinkInfo, LinkKind, Settings
from udp_mesh.core.subscriptions.messages import Subscription
from udp_mesh.crypto.signing import SEED_BYTES
from udp_mesh.sim.event_queue import SimEventQueue
from udp_mesh.sim.medium import Loss, Medium, RadioChannel, RadioFrame
from udp_mesh.sim.thin_team import Deliver, ThinMedia

LINK = "mesh0"
BROADCAST = "10.255.255.255"
# A node's timer may lie in the past right after an input; virtual time must still advance.
_MIN_STEP_S = 1e-6

OnEvent = Callable[[float, str, Event], None]
"""(now, robot, event of its node)."""


@dataclass(slots=True)
class Ledger:
    """Outcomes of every accepted reliable message: (robot, message, destination) -> outcomes."""

    accepted: int = 0
    rejected: Counter[str] = field(default_factory=Counter)
    """Rejected messages by reason."""
    outcomes: dict[tuple[str, int, MessageId, str], list[str]] = field(default_factory=dict)

    def note(self, robot: str, run: int, event: Event) -> None:
        match event:
            case MessageDelivered(message_id, peer) | MessagePeerLost(message_id, peer):
                kind = type(event).__name__
            case MessageExpired(message_id, peer):
                kind = type(event).__name__
            case _:
                return
        self.outcomes.setdefault((robot, run, message_id, peer), []).append(kind)

    @property
    def ended_twice(self) -> list[tuple[str, int, MessageId, str]]:
        """Messages with more than one outcome for one destination, which must not exist."""
        return [key for key, kinds in self.outcomes.items() if len(kinds) > 1]

    def total(self, kind: type[Event]) -> int:
        return sum(kinds.count(kind.__name__) for kinds in self.outcomes.values())


@dataclass(slots=True)
class _Robot:
    name: str
    address: str
    node: Endpoint
    link: LinkInfo
    run: int = 0
    is_running: bool = True
    wakes_at_s: float = float("inf")


class Team:
    """`robots` maps names to settings; `relays` forward frames and have no transport; `thin` makes the thin links."""

    def __init__(
        self,
        robots: Mapping[str, Settings],
        *,
        relays: Iterable[str] = (),
        channel: RadioChannel,
        loss: Loss,
        seed: int,
        on_event: OnEvent | None = None,
        thin: Callable[[SimEventQueue, Deliver, random.Random], ThinMedia] | None = None,
    ) -> None:
        self.event_queue = SimEventQueue()
        self.ledger = Ledger()
        self._rng = random.Random(seed)
        self._on_event = on_event or (lambda now, robot, event: None)
        names = [*robots, *relays]
        self.medium = Medium(self.event_queue, channel, names, loss, self._deliver, random.Random(self._rng.random()))
        self.thin = None if thin is None else thin(self.event_queue, self._deliver_thin, random.Random(seed))
        self._addresses: dict[str, str] = {}
        self._log_stores: dict[str, MemoryLogStore] = {}
        """The robots' disks, which outlast a crash."""
        self._members: dict[str, _Robot] = {}
        for number, (name, settings) in enumerate(robots.items(), 1):
            address = f"10.0.{number // 250}.{number % 250 + 1}"
            self._members[name] = self._started(name, address, settings, run=0)
            self._addresses[address] = name
        for member in self._members.values():
            self._pump(member)

    def _started(self, name: str, address: str, settings: Settings, run: int) -> _Robot:
        link = LinkInfo(LINK, LinkKind.BROADCAST, (address, settings.port), (BROADCAST, settings.port))
        boot_id = self._rng.randbytes(16)
        rng = random.Random(self._rng.random())
        store = self._log_store(name, settings)
        node = Endpoint(settings, boot_id=boot_id, rng=rng, now=self.event_queue.now, log_store=store)
        node.link_up(link, self.event_queue.now)
        return _Robot(name, address, node, link, run)

    def _log_store(self, name: str, settings: Settings) -> MemoryLogStore | None:
        if name not in self._log_stores and any(topic.log is not None for topic in settings.topics):
            seed = self._rng.randbytes(SEED_BYTES)
            self._log_stores[name] = MemoryLogStore(seed, clock=lambda: self.event_queue.now)
        return self._log_stores.get(name)

    # Called by the scenario

    def send(self, robot: str, topic: str, payload: bytes, destination: str | None = None) -> MessageId | Rejected:
        """Sends a message now. Raises ValueError if the robot is not running."""
        member = self._members[robot]
        if not member.is_running:
            raise ValueError(f"{robot} is not running")
        result = member.node.send(topic, payload, destination=destination, now=self.event_queue.now)
        if isinstance(result, Rejected):
            self.ledger.rejected[result.reason.value] += 1
        else:
            self.ledger.accepted += 1
        self._pump(member)
        return result

    def is_running(self, robot: str) -> bool:
        return self._members[robot].is_running

    def crash(self, robot: str) -> None:
        """Ends the process; its state is lost."""
        self._members[robot].is_running = False

    def restart(self, robot: str, settings: Settings) -> None:
        """Starts a new run of the same robot."""
        old = self._members[robot]
        self._members[robot] = self._started(robot, old.address, settings, old.run + 1)
        self._pump(self._members[robot])

    def change_address(self, robot: str, address: str) -> None:
        """Moves a running robot to another address."""
        member = self._members[robot]
        self._addresses.pop(member.address, None)
        self._addresses[address] = robot
        member.address = address
        member.link = replace(member.link, address=(address, member.link.address[1]))
        member.node.link_up(member.link, self.event_queue.now)
        self._pump(member)

    def apply(self, robot: str, settings: Settings) -> list[str]:
        """Changes a running robot's settings."""
        changes = self._members[robot].node.apply(settings, self.event_queue.now)
        self._pump(self._members[robot])
        return changes

    def conditions(self, robot: str) -> Conditions:
        return self._members[robot].node.conditions(self.event_queue.now)

    def subscribe(self, robot: str, subscriptions: Iterable[Subscription]) -> None:
        """Set what the robot's programs read from now on."""
        member = self._members[robot]
        member.node.selective.set_subscriptions(subscriptions, self.event_queue.now)
        self._pump(member)

    def saved(self, robot: str) -> tuple[int, int]:
        """Messages and bytes that the robot's current run did not send because no program wants them."""
        conditions = self._members[robot].node.selective.conditions()
        counters = [conditions.broadcasts, *(peer.saved for peer in conditions.peers)]
        return sum(counter.messages for counter in counters), sum(counter.bytes for counter in counters)

    # Called by the medium and the timers

    def _deliver(self, robot: str, frame: RadioFrame) -> None:
        member = self._members.get(robot)
        source = self._members.get(frame.source)
        if member is None or source is None or not member.is_running:
            return
        member.node.receive(frame.data, LINK, (source.address, source.link.address[1]), self.event_queue.now)
        self._pump(member)

    def _deliver_thin(self, robot: str, link: str, frame: bytes) -> None:
        member = self._members[robot]
        if member.is_running:
            member.node.receive(frame, link, ("", 0), self.event_queue.now)
            self._pump(member)

    def _pump(self, member: _Robot) -> None:
        now = self.event_queue.now
        while datagrams := member.node.datagrams_to_send(now):
            for datagram in datagrams:
                if self.thin is not None and self.thin.send(member.name, datagram.link, datagram.data):
                    continue
                to_all = datagram.destination is None or datagram.destination[0] == BROADCAST
                to = None if datagram.destination is None else self._addresses.get(datagram.destination[0])
                if to_all or to is not None:
                    self.medium.send(member.name, to, bytes(datagram.data), urgent=datagram.urgent)
        while (event := member.node.next_event()) is not None:
            self.ledger.note(member.name, member.run, event)
            self._on_event(now, member.name, event)
        timer_s = member.node.next_timer()
        if timer_s is not None and timer_s < member.wakes_at_s:
            member.wakes_at_s = max(timer_s, now + _MIN_STEP_S)
            self.event_queue.at(member.wakes_at_s, partial(self._wake, member))

    def _wake(self, member: _Robot) -> None:
        if (
            self.event_queue.now < member.wakes_at_s
            or not member.is_running
            or self._members[member.name] is not member
        ):
            return
        member.wakes_at_s = float("inf")
        member.node.handle_timer(self.event_queue.now)
        self._pump(member)
