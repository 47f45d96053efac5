"""Random teams whose networks do what they should not: `python -m tests.udp_mesh.core.promises 0 2000 --hostile`.

Networks deliver again what was sent minutes or boots ago, from wherever; change bits; pass only broadcasts or only
unicasts, or nothing large from one member; refuse to send; and give the address of one member to another. Nodes restart
in a loop. What `promises` checks holds nevertheless.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import partial

from tests.udp_mesh.core.random_teams import RandomTeam
from udp_mesh.core.interfaces import Datagram
from udp_mesh.core.settings import Address
from udp_mesh.sim.topology import SimNetwork

HOSTILE_CHANGES = (
    *("again", "again", "much-later", "from-elsewhere", "damage", "filter", "narrow", "refuse"),
    *("exchange", "restarts"),
)
RECORDED = 2000
"""Datagrams that may come again."""
ANY_SIZE = 1 << 16


@dataclass
class Faults:
    """What is wrong with one network."""

    damage: float = 0.0
    """Share of datagrams with a changed bit, although their checksum is right."""
    only: str = ""
    """What alone passes: `broadcast` or `unicast`; empty: both."""
    room: dict[str, int] = field(default_factory=dict)
    """By sender: larger datagrams vanish, in this direction only."""
    refusing: set[str] = field(default_factory=set)
    """Members whose kernel refuses to send (ENOBUFS, EPERM)."""


class HostileTeam(RandomTeam):
    """A team that follows from its seed."""

    def __init__(self, seed: int) -> None:
        self.faults: dict[str, Faults] = {}
        self._recorded: deque[tuple[str, SimNetwork, bytes, Address]] = deque(maxlen=RECORDED)
        self.replays_until = 0.0
        super().__init__(seed)

    def add_network(self, network: SimNetwork) -> SimNetwork:
        self.faults[network.name] = Faults()
        return super().add_network(network)

    # The network

    def _transmit(self, name: str, datagram: Datagram) -> None:
        network, faults = self.networks[datagram.link], self.faults[datagram.link]
        kind = "broadcast" if datagram.destination in (None, network.broadcast) else "unicast"
        self._record_for_all(name, network, datagram)
        vanishes = faults.only not in ("", kind) or len(datagram.data) > faults.room.get(name, ANY_SIZE)
        if vanishes or name in faults.refusing:
            self._on_datagram(name, network.name, datagram, self.now)
            return
        super()._transmit(name, datagram)

    def _arrive(self, name: str, network: SimNetwork, data: bytes, source: Address) -> None:
        if self.rng.random() < self.faults[network.name].damage:
            damaged = bytearray(data)
            damaged[self.rng.randrange(len(data))] ^= 1 << self.rng.randrange(8)
            data = bytes(damaged)
        super()._arrive(name, network, data, source)

    def _record_for_all(self, name: str, network: SimNetwork, datagram: Datagram) -> None:
        """Recorded near the sender: also what its receivers do not hear."""
        for member in network.members:
            if member != name and datagram.destination in (None, network.broadcast, network.address(member)):
                self._recorded.append((member, network, bytes(datagram.data), network.address(name)))

    def come_again(self, count: int, delays_s: Iterable[float], source: Address | None = None) -> None:
        """Deliver recorded datagrams once more, after a while, maybe from another address."""
        for delay_s in delays_s:
            self.replays_until = max(self.replays_until, self.now + delay_s + 1.0)
            for name, network, data, sent_from in self.rng.sample(
                list(self._recorded), min(count, len(self._recorded))
            ):
                again = partial(super()._arrive, name, network, data, source or sent_from)
                self.event_queue.after(delay_s + self.rng.random(), again)

    # What happens

    def change(self) -> None:
        """One random change, mostly a hostile one."""
        if self.dice.random() < 0.4:
            super().change()
            return
        dice, network = self.dice, self.dice.choice(list(self.networks.values()))
        faults, name = self.faults[network.name], self.dice.choice(list(self.homes))
        match dice.choice(HOSTILE_CHANGES):
            case "again":
                self.come_again(dice.choice((5, 200)), [dice.choice((0.0, 2.0, 12.0, 30.0))])
            case "much-later":
                self.come_again(50, [60.0, 180.0])
            case "from-elsewhere":
                taken = network.address(name) if name in network.members else network.broadcast
                self.come_again(100, [0.0, 5.0], dice.choice((taken, (f"10.{network.number}.9.9", 1234))))
            case "damage":
                faults.damage = dice.choice((0.0, 0.01, 0.3))
            case "filter":
                faults.only = dice.choice(("", "broadcast", "unicast"))
            case "narrow":
                faults.room[name] = dice.choice((ANY_SIZE, 1400, 1250, 600))
                self.narrowed |= {(name, other) for other in self.homes}
            case "refuse":
                faults.refusing.add(name)
                self.event_queue.after(dice.choice((0.02, 1.0, 10.0)), lambda: faults.refusing.discard(name))
            case "exchange" if len(network.members) > 1:
                self._exchange_addresses(network, *dice.sample(network.members, 2))
            case "restarts" if name in self.nodes:
                self._restart_often(name, dice.choice((3, 10)))

    def _exchange_addresses(self, network: SimNetwork, one: str, other: str) -> None:
        """Two members get each other's address, as from a DHCP server that lost its leases."""
        places = network.members.index(one), network.members.index(other)
        network.members[places[0]], network.members[places[1]] = other, one
        for name in (one, other):
            self._plug_in(name, network.name)

    def _restart_often(self, name: str, times: int) -> None:
        """A daemon that ends right after it has started, again and again."""
        if name in self.nodes:
            self.kill(name)
        self._start_again(name)
        if times:
            self.event_queue.after(self.dice.choice((0.05, 0.4, 1.5)), lambda: self._restart_often(name, times - 1))

    def repair(self) -> None:
        """Networks do again what they should."""
        for name in self.networks:
            self.faults[name] = Faults()
        super().repair()
