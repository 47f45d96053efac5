"""The packets in flight to one peer: sent -> acknowledged or lost.

Packet numbers grow by one and are never reused, so packets form a queue by number, and an acknowledgment's bitmap is
applied from its front: usually a run of ones. A packet is lost when `reorder_packets` later ones arrived; if it arrives
after all, that threshold grows. Urgent packets overtake others in a radio's queues (Wi-Fi access categories), so their
arrival says nothing about less urgent ones sent before them.
"""

from collections import OrderedDict, deque
from functools import partial
from itertools import repeat
from typing import NamedTuple

from udp_mesh.core.sender.message import OutgoingMessage

REORDER_PACKETS = 3
"""kPacketThreshold of RFC 9002, 6.1.1: a lower value takes reordering for loss, a higher one delays detection."""

MAX_REORDER_PACKETS = 64
"""Upper bound of the learned reordering threshold."""

REMEMBERED_NUMBERS = 2048
"""A later acknowledgment corrects the loss of the last so many packets. At 90 Mbit/s so many are sent into an outage
until the peer counts as unresponsive, and what a radio's queue kept of them arrives after it."""


class SendSnapshot(NamedTuple):
    """The state in which a burst of packets was sent, shared by all of them, for round trip and rate samples."""

    sent_at: float
    delivered: int
    """Packets acknowledged until then."""
    delivered_at: float
    """When the last of those was acknowledged."""
    delivered_sent_at: float
    """When the last of those was sent."""
    app_limited: bool
    """The application, not the window, limited how much was sent."""
    urgent: bool = False
    first: int = 0
    """Number of the burst's first packet."""
    outstanding: int = 0
    """Packets in flight when it was sent."""
    copy: bool = False
    """A redundant copy of an urgent fragment."""

    def packets_ahead_of(self, number: int) -> int:
        """Packets in flight when packet `number` of the burst was sent."""
        return self.outstanding + number - self.first


class Packet(NamedTuple):
    """One packet in flight and the fragments in it."""

    snapshot: SendSnapshot
    message: OutgoingMessage
    position: int
    more: tuple[tuple[OutgoingMessage, int], ...] = ()


class SentPackets:
    """`outstanding` counts the packets neither acknowledged nor lost, `copies` the redundant copies among them."""

    __slots__ = (
        "_largest_other",
        "_lost",
        "_packets",
        "_timed_out",
        "base",
        "copies",
        "outstanding",
        "reorder_packets",
        "spurious",
    )

    def __init__(self) -> None:
        self.base = 0
        """Number of the packet at the front of the queue."""
        self._packets: deque[Packet | None] = deque()
        self._largest_other = -1
        """Largest acknowledged number of a packet that was not urgent."""
        self.outstanding = self.copies = 0
        self.reorder_packets = REORDER_PACKETS
        self._lost: OrderedDict[int, tuple[Packet, bool]] = OrderedDict()
        """By number, in the order of the numbers, and whether later packets overtook it."""
        self._timed_out: list[int] = []
        """Numbers of urgent packets declared lost by age and not yet covered by an acknowledgment."""
        self.spurious = 0

    @property
    def next_number(self) -> int:
        return self.base + len(self._packets)

    def non_urgent_outstanding(self) -> int:
        """How many of `outstanding` are not urgent. Walks the queue."""
        return sum(packet is not None and not packet.snapshot.urgent for packet in self._packets)

    def add(self, number: int, packet: Packet | None) -> None:
        """Record a sent packet; None for one that requests no acknowledgment. Called for every number of the channel,
        in order, from when it has a sender: earlier ones requested no acknowledgment."""
        packets = self._packets
        if not packets:
            self.base = number if packet is not None else number + 1
        if packet is not None:
            self.outstanding += 1
            self.copies += packet.snapshot.copy
        elif not packets:
            return
        packets.append(packet)

    def add_run(self, number: int, snapshot: SendSnapshot, message: OutgoingMessage, positions: range) -> None:
        """Record one packet per fragment, from `number` on, without a Python call for each."""
        if not self._packets:
            self.base = number
        self.outstanding += len(positions)
        self._packets.extend(
            map(partial(tuple.__new__, Packet), zip(repeat(snapshot), repeat(message), positions, repeat(())))
        )

    def acknowledge(self, largest: int, received: int) -> tuple[list[Packet], list[Packet], Packet | None]:
        """Returns the newly acknowledged packets, the packets now lost, and packet `largest` if it was not acknowledged
        before.

        `received` is as in `AckState`. An acknowledgment of a number never sent is ignored. A packet declared lost too
        early is returned as `largest` too: otherwise a path that became slow would never be measured.
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
            self._count_out(acknowledged[corrected:])
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
        # Packets behind one that may still arrive: at most the reordering threshold.
        for behind in range(count):
            packet = packets[count - 1 - behind]
            if packet is not None and received >> behind & 1:
                acknowledged.append(packet)
                packets[count - 1 - behind] = None
        self._count_out(acknowledged[corrected:])
        self._count_out(lost)
        return acknowledged, lost, newest

    def confirm_timed_out(self, largest: int, received: int) -> int:
        """How many timed-out urgent packets this acknowledgment shows to be really lost."""
        conclusive = largest - self.reorder_packets
        lost = 0
        while self._timed_out and self._timed_out[0] <= conclusive:
            lost += not received >> (largest - self._timed_out.pop(0)) & 1
        return lost

    def abandon_all(self) -> list[Packet]:
        """Declare everything in flight lost because the peer is unresponsive; a later acknowledgment may correct
        that."""
        lost = [packet for packet in self._packets if packet is not None]
        for number, packet in enumerate(self._packets, self.base):
            if packet is not None:
                self._remember(number, packet, overtaken=False)
        self.base += len(self._packets)
        self._packets.clear()
        # An outage says nothing about the loss rate of the path.
        self._timed_out.clear()
        self.outstanding = self.copies = 0
        return lost

    def restart(self, number: int) -> list[Packet]:
        """Discard everything in flight: the peer restarted and received none of it. Returns those packets."""
        lost = [packet for packet in self._packets if packet is not None]
        self._packets.clear()
        self._lost.clear()
        self._largest_other = -1
        self._timed_out.clear()
        self.base = number
        self.outstanding = self.copies = 0
        return lost

    def oldest(self) -> SendSnapshot | None:
        """The snapshot of the oldest packet in flight."""
        packets = self._packets
        while packets and packets[0] is None:
            packets.popleft()
            self.base += 1
        front = packets[0] if packets else None
        return front.snapshot if front is not None else None

    def declare_lost_before(self, sent_before: float) -> list[Packet]:
        """Declare packets sent before that time lost."""
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
        self._count_out(lost)
        return lost

    def _count_out(self, packets: list[Packet]) -> None:
        """Packets that are no longer in flight."""
        self.outstanding -= len(packets)
        if self.copies:
            self.copies -= sum(packet.snapshot.copy for packet in packets)

    def _remember(self, number: int, packet: Packet, *, overtaken: bool) -> None:
        self._lost[number] = (packet, overtaken)
        while next(iter(self._lost)) <= number - REMEMBERED_NUMBERS:
            self._lost.popitem(last=False)

    def _undo_loss(self, largest: int, received: int, acknowledged: list[Packet]) -> None:
        oldest = largest - received.bit_length() + 1
        late = []
        for number in reversed(self._lost):
            if number < oldest:
                break
            if number <= largest and received >> (largest - number) & 1:
                late.append(number)
        for number in reversed(late):
            packet, overtaken = self._lost.pop(number)
            acknowledged.append(packet)
            self.spurious += 1
            if overtaken:
                self.reorder_packets = min(MAX_REORDER_PACKETS, self.reorder_packets + 1)
