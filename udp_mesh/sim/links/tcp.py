"""A TCP flow with endless data, as foreign traffic on a path: segments out, selective acknowledgments back.

1. `_send` sends while the controller's window and pacing rate allow; lost segments go first.
2. The receiver acknowledges every second segment, or after `DELAYED_ACK_S`, and at once out of order (RFC 5681, 4.2).
3. A segment is lost when `REORDER_SEGMENTS` sent after it were acknowledged (RFC 8985, without its reordering window),
   or after the retransmission timeout (RFC 6298, with Linux's minimum of 200 ms).
4. Each acknowledgment gives the controller a delivery rate sample (draft-cheng-iccrg-delivery-rate-estimation).

Not modeled: receive windows, ECN, offload, tail loss probes; an acknowledgment carries all blocks instead of three.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from udp_mesh.sim.event_queue import SimEventQueue
from udp_mesh.sim.links.path import Carrier

SEGMENT_BYTES = 1500
PAYLOAD_BYTES = 1448
"""IPv4 and TCP headers with timestamps."""

ACK_BYTES = 64
DELAYED_ACK_S = 0.040
REORDER_SEGMENTS = 3
INITIAL_RTO_S = 1.0
MIN_RTO_S = 0.2
INITIAL_CWND = 10.0
"""RFC 6928."""


@dataclass(frozen=True, slots=True)
class AckSample:
    """The information in one acknowledgment for a controller."""

    now: float
    acked: int
    """Segments newly acknowledged."""
    rtt_s: float | None
    """None if only retransmitted segments were acknowledged."""
    rate: float | None
    """Segments per second."""
    in_flight: int
    delivered: int
    """Segments acknowledged since the start."""
    delivered_at_send: int
    """The same when the newest acknowledged segment was sent."""


class TcpController(Protocol):
    """A congestion control algorithm, in segments."""

    @property
    def cwnd(self) -> float: ...

    def pacing_rate(self) -> float | None:
        """Segments per second; None: as the window allows."""
        ...

    def on_ack(self, sample: AckSample) -> None: ...

    def on_loss(self, now: float, in_flight: int) -> None:
        """The first loss of a round trip."""
        ...

    def on_timeout(self, now: float) -> None: ...


@dataclass(slots=True)
class _Sent:
    order: int
    sent_at: float
    delivered: int
    delivered_at: float
    first_sent_at: float
    is_retransmission: bool


class TcpFlow:
    """Starts to send at `start_s`."""

    def __init__(
        self,
        event_queue: SimEventQueue,
        controller: TcpController,
        forward: Carrier,
        backward: Carrier,
        *,
        start_s: float = 0.0,
    ) -> None:
        self._event_queue = event_queue
        self.controller = controller
        self._forward = forward
        self._backward = backward
        self.received_bytes = 0
        """Payload that the receiver has, in whatever order."""
        # Sender
        self._next_number = 0
        self._orders = 0
        self._in_flight: dict[int, _Sent] = {}
        self._lost: list[int] = []
        self._recovers_at_order = -1
        self._delivered = 0
        self._delivered_at = self._first_sent_at = start_s
        self._smoothed_rtt_s: float | None = None
        self._rttvar_s = 0.0
        self._rto_factor = 1
        self._progress_at = start_s
        self._timer_at = float("inf")
        self._free_at = start_s
        self._wakes_at = float("inf")
        # Receiver
        self._expected = 0
        self._ahead: set[int] = set()
        self._unacknowledged = 0
        event_queue.at(start_s, self._send)

    @property
    def in_flight(self) -> int:
        return len(self._in_flight)

    # Sender

    def _send(self) -> None:
        now = self._event_queue.now
        while len(self._in_flight) < int(self.controller.cwnd):
            rate = self.controller.pacing_rate()
            if rate is not None and self._free_at > now + 1e-9:
                if self._wakes_at > self._free_at or self._wakes_at <= now:
                    self._wakes_at = self._free_at
                    self._event_queue.at(self._free_at, self._send)
                break
            if rate is not None:
                self._free_at = max(self._free_at, now - 0.001) + 1.0 / rate
            self._transmit(now)
        self._arm()

    def _transmit(self, now: float) -> None:
        is_retransmission = bool(self._lost)
        if is_retransmission:
            number = self._lost.pop(0)
        else:
            number, self._next_number = self._next_number, self._next_number + 1
        if not self._in_flight:
            self._delivered_at = self._first_sent_at = self._progress_at = now
        self._orders += 1
        self._in_flight[number] = _Sent(
            self._orders, now, self._delivered, self._delivered_at, self._first_sent_at, is_retransmission
        )
        self._forward.send(SEGMENT_BYTES, lambda: self._on_segment(number))

    def _on_ack(self, expected: int, ahead: frozenset[int]) -> None:
        now = self._event_queue.now
        acked = [number for number in self._in_flight if number < expected or number in ahead]
        self._lost = [number for number in self._lost if number >= expected and number not in ahead]
        if not acked:
            return
        sent = [self._in_flight.pop(number) for number in acked]
        newest = max(sent, key=lambda segment: segment.order)
        self._delivered += len(acked)
        self._progress_at, self._rto_factor = now, 1
        rtt_s = None if newest.is_retransmission else now - newest.sent_at
        if rtt_s is not None:
            self._sample_rtt(rtt_s)
        elapsed_s = max(now - newest.delivered_at, newest.sent_at - newest.first_sent_at)
        rate = (self._delivered - newest.delivered) / elapsed_s if elapsed_s > 0 else None
        self._delivered_at, self._first_sent_at = now, newest.sent_at
        lost = [
            number for number, segment in self._in_flight.items() if segment.order <= newest.order - REORDER_SEGMENTS
        ]
        if lost:
            in_flight = len(self._in_flight)
            is_new_episode = any(self._in_flight[number].order > self._recovers_at_order for number in lost)
            for number in lost:
                del self._in_flight[number]
            self._lost = sorted({*self._lost, *lost})
            if is_new_episode:
                self._recovers_at_order = self._orders
                self.controller.on_loss(now, in_flight)
        self.controller.on_ack(
            AckSample(now, len(acked), rtt_s, rate, len(self._in_flight), self._delivered, newest.delivered)
        )
        self._send()

    def _sample_rtt(self, rtt_s: float) -> None:
        if self._smoothed_rtt_s is None:
            self._smoothed_rtt_s, self._rttvar_s = rtt_s, rtt_s / 2
        else:
            self._rttvar_s += (abs(self._smoothed_rtt_s - rtt_s) - self._rttvar_s) / 4
            self._smoothed_rtt_s += (rtt_s - self._smoothed_rtt_s) / 8

    def _rto_at(self) -> float:
        rto_s = INITIAL_RTO_S
        if self._smoothed_rtt_s is not None:
            rto_s = self._smoothed_rtt_s + max(MIN_RTO_S, 4 * self._rttvar_s)
        return self._progress_at + rto_s * self._rto_factor

    def _arm(self) -> None:
        if self._in_flight and self._timer_at == float("inf"):
            self._timer_at = self._rto_at()
            self._event_queue.at(self._timer_at, self._on_timer)

    def _on_timer(self) -> None:
        now = self._event_queue.now
        self._timer_at = float("inf")
        if self._in_flight and now >= self._rto_at() - 1e-9:
            self._lost = sorted({*self._lost, *self._in_flight})
            self._in_flight.clear()
            self._recovers_at_order = self._orders
            self._rto_factor = min(64, 2 * self._rto_factor)
            self._progress_at = now
            self.controller.on_timeout(now)
            self._send()
        self._arm()

    # Receiver

    def _on_segment(self, number: int) -> None:
        if number >= self._expected and number not in self._ahead:
            self.received_bytes += PAYLOAD_BYTES
            self._ahead.add(number)
        in_order = number == self._expected
        while self._expected in self._ahead:
            self._ahead.remove(self._expected)
            self._expected += 1
        self._unacknowledged += 1
        if self._unacknowledged >= 2 or not in_order or self._ahead:
            self._acknowledge()
        else:
            self._event_queue.after(DELAYED_ACK_S, self._on_delayed_ack)

    def _on_delayed_ack(self) -> None:
        if self._unacknowledged:
            self._acknowledge()

    def _acknowledge(self) -> None:
        self._unacknowledged = 0
        expected, ahead = self._expected, frozenset(self._ahead)
        self._backward.send(ACK_BYTES, lambda: self._on_ack(expected, ahead))
