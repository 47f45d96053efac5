"""Neighbors of the relay layer: who is heard on which link, how well in both directions, and what waits for them.

The quality of a link is the share of recent hellos that arrived, ours there and theirs here. A neighbor counts only
once its hello shows that it heard a recent one of ours: the link works both ways, and the hello is no recording.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from udp_mesh.core.relaying.hop_channel import Hop
from udp_mesh.core.relaying.hop_queue import HopQueue, QueueBudget
from udp_mesh.core.relaying.hop_window import HopWindow
from udp_mesh.core.settings import Address
from udp_mesh.wire.limits import HEARD_TAG_BYTES
from udp_mesh.wire.relay import HeardHop, RelayHello

HISTORY_ROUNDS = 16
"""Hellos over which quality is measured."""
MISSED_HELLOS = 3.5
"""Announced intervals without a hello after which a link is gone."""
LINK_COST = 16
"""Cost of a link that loses nothing: one transmission."""
MAX_LINK_COST = 16 * 64
"""Cost of one of which nearly nothing arrives."""
SUSPECT_COST = 16 * LINK_COST
"""Added while what is sent to a neighbor is not acknowledged: another route is better, but none is worse."""
ACK_EVERY = 8
"""Carried datagrams per acknowledgment of a hop."""
ACK_DELAY_S = 0.008
_HISTORY = (1 << HISTORY_ROUNDS) - 1


@dataclass(slots=True)
class HopLink:
    """One link on which a neighbor is heard."""

    name: str
    address: Address
    mtu: int
    round: int = -1
    """Of its newest hello."""
    hello_at: float = 0.0
    history: int = 0
    """One bit per round, the newest in bit 0."""
    rounds: int = 0
    echo: int = -1
    """Our newest hello that it heard."""
    reported: int = 0
    """Share of our hellos that it heard, 0 to 255."""
    reported_at: float = float("-inf")

    def on_hello(self, number: int, now: float) -> None:
        passed = number - self.round if self.round >= 0 else 1
        if passed > 0:
            self.history = (self.history << min(passed, HISTORY_ROUNDS) | 1) & _HISTORY
            self.rounds = min(HISTORY_ROUNDS, self.rounds + passed)
            self.round, self.hello_at = number, now

    def quality(self, interval_s: float, now: float) -> float:
        """Share of its recent hellos that arrived; those now overdue count as missed."""
        missed = max(0, int((now - self.hello_at) / interval_s - 0.5))
        rounds = min(HISTORY_ROUNDS, self.rounds + missed)
        return ((self.history << missed) & _HISTORY).bit_count() / rounds if rounds else 0.0

    def works(self, interval_s: float, own_round: int, now: float) -> bool:
        """Whether both directions were proven to work recently."""
        window_s = MISSED_HELLOS * interval_s
        return (
            now - self.hello_at <= window_s
            and now - self.reported_at <= window_s
            and 0 <= own_round - self.echo <= HISTORY_ROUNDS
        )

    def cost(self, interval_s: float, now: float) -> int:
        """Expected transmissions of a datagram and its acknowledgment (ETX), in sixteenths."""
        both = self.quality(interval_s, now) * self.reported / 255
        return min(MAX_LINK_COST, round(LINK_COST / both)) if both > LINK_COST / MAX_LINK_COST else MAX_LINK_COST


@dataclass(eq=False, slots=True)
class HopNeighbor:
    """One boot of a node that is heard directly."""

    hop: Hop
    queue: HopQueue
    name: str = ""
    relays: bool = False
    passes_us: bool = False
    """It relays for us, with any other end."""
    interval_s: float = 1.0
    proofs: tuple[bytes, ...] = ()
    round: int = 0
    links: dict[str, HopLink] = field(default_factory=dict)
    window: HopWindow = field(default_factory=HopWindow)
    unacknowledged: int = 0
    """Carried datagrams since our last acknowledgment."""
    largest: int = -1
    largest_at: float = 0.0
    ack_at: float = float("inf")

    @property
    def boot_id(self) -> bytes:
        return self.hop.boot_id

    @property
    def tag(self) -> bytes:
        return self.hop.boot_id[:HEARD_TAG_BYTES]

    def best_link(self, own_round: int, now: float) -> HopLink | None:
        """The working link of least cost."""
        working = [link for link in self.links.values() if link.works(self.interval_s, own_round, now)]
        return min(working, key=lambda link: link.cost(self.interval_s, now), default=None)

    def cost(self, own_round: int, now: float) -> int | None:
        """Cost of reaching it; None if it is not reached."""
        link = self.best_link(own_round, now)
        if link is None:
            return None
        return link.cost(self.interval_s, now) + (SUSPECT_COST if self.window.suspect else 0)

    def heard_at(self) -> float:
        return max((link.hello_at for link in self.links.values()), default=float("-inf"))

    def on_carried(self, number: int, now: float) -> None:
        """A carried datagram arrived: acknowledge it, with others or soon."""
        self.unacknowledged += 1
        if number > self.largest:
            self.largest, self.largest_at = number, now
        self.ack_at = now if self.unacknowledged >= ACK_EVERY else min(self.ack_at, now + ACK_DELAY_S)


def make_neighbor(hop: Hop, budget: QueueBudget) -> HopNeighbor:
    return HopNeighbor(hop, HopQueue(budget))


def on_hello(
    neighbor: HopNeighbor, hello: RelayHello, own_tag: bytes, link: str, address: Address, mtu: int, now: float
) -> HopLink:
    """Record what a hello says about its sender and about the link it came on."""
    neighbor.name, neighbor.relays, neighbor.proofs = hello.name, hello.relays, hello.proofs
    neighbor.interval_s = hello.interval_ms / 1000
    neighbor.round = max(neighbor.round, hello.round)
    hop_link = neighbor.links.get(link)
    if hop_link is None:
        hop_link = neighbor.links[link] = HopLink(link, address, mtu)
    hop_link.address, hop_link.mtu = address, mtu
    hop_link.on_hello(hello.round, now)
    for heard in hello.heard:
        if heard.tag == own_tag:
            if heard.round > hop_link.echo:
                # It hears us (again).
                neighbor.window.timeouts = 0
            neighbor.passes_us = heard.passes
            hop_link.echo, hop_link.reported, hop_link.reported_at = heard.round, heard.quality, now
    return hop_link


def heard_on(link: HopLink, neighbor: HopNeighbor, *, passes: bool, now: float) -> HeardHop:
    """Our report to a neighbor about its hellos on a link."""
    quality = round(255 * link.quality(neighbor.interval_s, now))
    return HeardHop(neighbor.tag, max(0, link.round), quality, passes)
