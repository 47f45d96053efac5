"""How many packets may be sent: while acknowledgments are late the link is assumed to keep delivering, for a bounded
time."""

from __future__ import annotations

import pytest

from tests.udp_mesh.core.test_links import Run
from udp_mesh.core.sender.send_quota import (
    ASSUMED_DELIVERY_S,
    LATE_AFTER_S,
    ack_spacing,
    cwnd_room,
    next_send_at,
    send_quota,
)
from udp_mesh.core.sender.send_state import SendState
from udp_mesh.core.sender.sender import Sender
from udp_mesh.core.settings import Settings


def busy_outbound(**link: object) -> tuple[Sender, float]:
    """A sender that has filled its link for a while, and the time of its last acknowledgment."""
    run = Run(urgent=False)
    run.link(**link)
    run.start()
    run.world.run(3.0)
    sender = run.world.nodes["a"]._state.peer_table.peers["b"].open_sender()
    return sender, sender.last_progress


def room(sender: Sender, now: float) -> int:
    return send_quota(sender, cwnd_room(sender, now), now, None, urgent=True)


def test_late_acknowledgements_do_not_stop_the_link() -> None:
    sender, heard = busy_outbound()
    capacity = sender.congestion.capacity_packets_per_s()
    assert capacity is not None
    later = room(sender, heard + 0.025) - room(sender, heard)
    assert 0.010 * capacity <= later <= 0.025 * capacity


def test_assumed_delivery_is_bounded() -> None:
    sender, heard = busy_outbound()
    capacity = sender.congestion.capacity_packets_per_s()
    assert capacity is not None
    assert room(sender, heard + 10.0) - room(sender, heard) <= ASSUMED_DELIVERY_S * capacity + 1


def test_when_a_full_window_is_looked_at_again() -> None:
    sender, heard = busy_outbound()
    late_at = heard + max(LATE_AFTER_S, ack_spacing(sender) / (sender.congestion.capacity_packets_per_s() or 0.0))
    quantum_s, rate = sender.rates.pace_quantum_s, sender.congestion.pacing_packets_per_s()
    # While delivery is assumed, and not after: only an acknowledgment changes something then.
    assert next_send_at(sender, 0, heard, rate) == pytest.approx(late_at + quantum_s)
    now = late_at + ASSUMED_DELIVERY_S / 2
    assert next_send_at(sender, 0, now, rate) == pytest.approx(now + quantum_s)
    assert next_send_at(sender, 0, late_at + ASSUMED_DELIVERY_S + 0.001, rate) is None
    # With room, when the pacer allows it.
    sender.pacer.on_sent(10, heard, rate)
    assert next_send_at(sender, 5, heard, rate) == sender.pacer.wake_at(rate)
    # Once packets timed out, a timer would wake the process every few milliseconds of an outage.
    sender.state = SendState.TIMING_OUT
    assert next_send_at(sender, 0, now, rate) is None
    sender.state = SendState.UNRESPONSIVE
    assert next_send_at(sender, 5, now, rate) is None


def test_no_delivery_is_assumed_on_a_link_with_a_foreign_queue() -> None:
    sender, heard = busy_outbound()
    min_rtt = sender.rtt.min_rtt
    assert min_rtt is not None
    for step in range(40):
        sender.rtt.sample(min_rtt + 0.1, heard + 0.005 * step)
    assert room(sender, heard + 0.06) == room(sender, heard)


def test_a_fixed_window_does_not_grow_while_acknowledgements_are_late() -> None:
    sender = Sender(Settings("a", unkeyed=True, window=3))
    assert room(sender, 100.0) == 3 + sender.rates.urgent_excess_packets


@pytest.mark.parametrize(("loss", "fewest", "most"), [(0.0, 4, 7), (0.2, 2, 3)])
def test_acknowledgements_are_requested_more_often_on_a_lossy_link(loss: float, fewest: int, most: int) -> None:
    sender, _ = busy_outbound(loss=loss)
    assert fewest <= ack_spacing(sender) <= most


def test_bursty_loss_of_acknowledgements_barely_reduces_goodput() -> None:
    def lost_in_bursts(seed: int) -> float:
        run = Run(urgent=False, seed=seed)
        for pipe in run.world.pipes.values():
            state = [False]

            def lost(rng: object, _: float, state: list[bool] = state) -> bool:
                # Gilbert-Elliott loss per frame: bursts of ten frames, a fifth of all.
                state[0] = rng.random() >= 0.1 if state[0] else rng.random() < 0.025  # type: ignore[attr-defined]
                return state[0]

            pipe.lost = lost
        run.start()
        run.world.run(2.0)
        return run.measure(12.0).goodput_bits_per_s

    assert sum(lost_in_bursts(seed) for seed in (1, 2, 3)) / 3 >= 0.90 * 0.8 * 10e6


def test_copies_occupy_no_window() -> None:
    sender, heard = busy_outbound()
    before = cwnd_room(sender, heard)
    sender.in_flight.copies += 2
    assert cwnd_room(sender, heard) == before + 2


def test_assumed_delivery_is_no_longer_queue_than_the_window_may_be() -> None:
    sender, heard = busy_outbound()
    capacity, min_rtt = sender.congestion.capacity_packets_per_s(), sender.rtt.min_rtt
    assert capacity is not None
    assert min_rtt is not None
    packets = cwnd_room(sender, heard + 10.0) + sender.in_flight.outstanding
    assert packets <= max(sender.congestion.cwnd, capacity * (min_rtt + ASSUMED_DELIVERY_S))
