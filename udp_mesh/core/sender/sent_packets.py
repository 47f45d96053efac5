"""The packets on their way to one peer: sent -> acknowledged or lost.

Packet numbers grow by one and are never used twice, so the packets stand in a queue by number and an acknowledgement's
bitmap walks it from the front: mostly a run of ones that is taken off in one go. A packet is lost when
`reorder_packets` later ones arrived; one that arrives after all teaches a larger number. Urgent packets overtake others
in a radio's queues (wifi's access categories), so their arrival says nothing about less urgent ones sent before them.
"""

from collections import OrderedDict, deque
from functools import partial
from itertools import repeat
from typing import NamedTuple

from udp_mesh.core.sender.message import OutgoingMessage

REORDER_PACKETS = 3
"""RFC 9002, 6.1.1: fewer calls reordering a loss, more waits longer."""

MAX_REORDER_PACKETS = 64
"""What learned reordering may reach."""

MAX_REMEMBERED_LOST = 256
"""Packets called lost that an acknowledgement may still correct: those its bitmap covers."""


class SendSnapshot(NamedTuple):
    """The state in which a burst of packets was sent, shared by all of them; for round trip and rate samples."""

    sent_at: float
    delivered: int
    """Packets acknowledged until then."""
    delivered_at: float
    """When the last of those was acknowledged."""
    delivered_sent_at: float
    """When the last of those had been sent."""
    app_limited: bool
    """The application, not the window, decided how much was sent."""
    urgent: bool = False
    first: int = 0
    """Number of the burst's first packet."""
    outstanding: int = 0
    """Packets that were on their way when it left."""

    def packets_ahead_of(self, number: int) -> int:
        """Packets of ours that were on their way when packet `number` of the burst left."""
        return self.outstanding + number - self.first


class Packet(NamedTuple):
    """One packet on its way, and the pieces of messages in it."""

    snapshot: SendSnapshot
    message: OutgoingMessage
    position: int
    more: tuple[tuple[OutgoingMessage, int], ...] = ()


class SentPackets:
    """`outstanding` counts the packets neither acknowledged nor lost."""

    __slots__ = (
        "_largest_other",
        "_lost",
        "_packets",
        "_timed_out",
        "base",
        "outstanding",
        "reorder_packets",
        "spurious",
    )

    def __init__(self) -> None:
        self.base = 0
        """Number of the packet at the front of the queue."""
        self._packets: deque[Packet | None] = deque()
        self._largest_other = -1
        """Largest number of a packet that was not urgent and arrived."""
        self.outstanding = 0
        self.reorder_packets = REORDER_PACKETS
        self._lost: OrderedDict[int, tuple[Packet, bool]] = OrderedDict()
        self._timed_out: list[int] = []
        """Numbers of urgent packets called lost by their age, of which no acknowledgement has told yet."""
        self.spurious = 0

    @property
    def next_number(self) -> int:
        return self.base + len(self._packets)

    def non_urgent_outstanding(self) -> int:
        """How many of `outstanding` are not urgent. Walks the queue."""
        return sum(packet is not None and not packet.snapshot.urgent for packet in self._packets)

    def add(self, number: int, packet: Packet | None) -> None:
        """A packet left; None for one that asks for no acknowledgement. Every number of the channel comes, in order."""
        packets = self._packets
        if packet is not None:
            self.outstanding += 1
        elif not packets:
            self.base = number + 1
            return
        packets.append(packet)

    def add_run(self, snapshot: SendSnapshot, message: OutgoingMessage, positions: range) -> None:
        """As `add` for a packet of each piece, which have the next numbers; without a call in Python for each."""
        self.outstanding += len(positions)
        self._packets.extend(
            map(partial(tuple.__new__, Packet), zip(repeat(snapshot), repeat(message), positions, repeat(())))
        )

    def acknowledge(self, largest: int, received: int) -> tuple[list[Packet], list[Packet], Packet | None]:
        """Packets newly acknowledged, packets now lost, and packet `largest` if this is the first word of it.

        `received` as in `AckState`. An acknowledgement of what was never sent says nothing. One of a packet called lost
        too early is the first word of it, too: without it a path that became slow would never be measured.
        """
        packets = self._packets
        base = self.base
        count = largest - base + 1
        acknowledged: list[Packet] = []
        lost: list[Packet] = []
        late: Packet | None = None
        if self._lost and largest < self.next_number:
            late = self._lost[largest][0] if largest in self._lost else None
            self._undo_loss(largest, received, acknowledged)
        if count <= 0 or count > len(packets):
            return acknowledged, lost, late
        newest = packets[count - 1]
        corrected = len(acknowledged)
        ones = (1 << count) - 1
        if received & ones == ones:
            take = packets.popleft
            for _ in range(count):
                packet = take()
                if packet is not None:
                    acknowledged.append(packet)
            self.base = largest + 1
            self.outstanding -= len(acknowledged) - corrected
            return acknowledged, lost, newest
        reorder = self.reorder_packets
        for behind in range(count):
            packet = packets[count - 1 - behind]
            if packet is not None and received >> behind & 1 and not packet.snapshot.urgent:
                self._largest_other = max(self._largest_other, largest - behind)
                break
        ahead = largest - self._largest_other
        while count:
            packet = packets[0]
            behind = count - 1
            if packet is not None:
                if received >> behind & 1:
                    acknowledged.append(packet)
                elif behind >= (reorder if packet.snapshot.urgent else reorder + ahead):
                    lost.append(packet)
                    self._remember(largest - behind, packet, overtaken=True)
                else:
                    break
            packets.popleft()
            count -= 1
        self.base = largest + 1 - count
        # What stands behind a packet that may still come: at most the reordering distance.
        for behind in range(count):
            packet = packets[count - 1 - behind]
            if packet is not None and received >> behind & 1:
                acknowledged.append(packet)
                packets[count - 1 - behind] = None
        self.outstanding -= len(acknowledged) - corrected + len(lost)
        return acknowledged, lost, newest

    def confirm_timed_out(self, largest: int, received: int) -> int:
        """How many urgent packets that timed out were lost indeed, as this acknowledgement tells."""
        conclusive = largest - self.reorder_packets
        lost = 0
        while self._timed_out and self._timed_out[0] <= conclusive:
            lost += not received >> (largest - self._timed_out.pop(0)) & 1
        return lost

    def abandon_all(self) -> list[Packet]:
        """Everything on its way counts as lost (the peer is silent); an acknowledgement may still correct that."""
        lost = [packet for packet in self._packets if packet is not None]
        for number, packet in enumerate(self._packets, self.base):
            if packet is not None:
                self._remember(number, packet, overtaken=False)
        self.base += len(self._packets)
        self._packets.clear()
        # A silence is a cut, which says nothing of the loss on the way.
        self._timed_out.clear()
        self.outstanding = 0
        return lost

    def restart(self, number: int) -> list[Packet]:
        """The peer runs anew: nothing of this was received. Returns what was on its way."""
        lost = [packet for packet in self._packets if packet is not None]
        self._packets.clear()
        self._lost.clear()
        self._largest_other = -1
        self._timed_out.clear()
        self.base = number
        self.outstanding = 0
        return lost

    def oldest(self) -> SendSnapshot | None:
        """The mark of the first packet still on its way."""
        packets = self._packets
        while packets and packets[0] is None:
            packets.popleft()
            self.base += 1
        front = packets[0] if packets else None
        return front.snapshot if front is not None else None

    def declare_lost_before(self, sent_before: float) -> list[Packet]:
        """Packets sent before that time count as lost."""
        packets = self._packets
        lost = []
        while packets:
            packet = packets[0]
            if packet is not None:
                if packet.snapshot.sent_at > sent_before + 1e-9:
                    break
                lost.append(packet)
                self._remember(self.base, packet, overtaken=False)
                if packet.snapshot.urgent:
                    self._timed_out.append(self.base)
            packets.popleft()
            self.base += 1
        self.outstanding -= len(lost)
        return lost

    def _remember(self, number: int, packet: Packet, *, overtaken: bool) -> None:
        self._lost[number] = (packet, overtaken)
        if len(self._lost) > MAX_REMEMBERED_LOST:
            self._lost.popitem(last=False)

    def _undo_loss(self, largest: int, received: int, acknowledged: list[Packet]) -> None:
        late = [number for number in self._lost if number <= largest and received >> (largest - number) & 1]
        for number in late:
            packet, overtaken = self._lost.pop(number)
            acknowledged.append(packet)
            self.spurious += 1
            if overtaken:
                self.reorder_packets = min(MAX_REORDER_PACKETS, self.reorder_packets + 1)
