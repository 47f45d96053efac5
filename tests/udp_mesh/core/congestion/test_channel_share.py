"""Several senders on one channel keep less queue each, in equal shares."""

from __future__ import annotations

import pytest

from udp_mesh.core.congestion.channel_share import MAX_SHARE, RATE_VALID_S, ChannelShare
from udp_mesh.core.congestion.delay_based import DelayBasedController
from udp_mesh.core.congestion.queue_target import MIN_QUEUE_PACKETS, UNSHARED_FROM_LOSS
from udp_mesh.core.congestion.rtt import RttEstimator


def channel_share(*rates: float) -> ChannelShare:
    made = ChannelShare()
    for number, rate in enumerate(rates):
        made.on_send_rate(bytes([number]), rate, 0.0)
    return made


def test_a_single_sender_keeps_the_whole_queue_despite_acknowledgement_traffic() -> None:
    assert channel_share().queue_share(1e6, 0.0) == 1.0
    assert channel_share(50_000.0).queue_share(1e6, 0.0) == 1.0


def test_queue_share_decreases_with_the_number_of_senders() -> None:
    shares = [channel_share(*[3e5] * others).queue_share(3e5, 0.0) for others in (0, 1, 3, 7)]
    assert shares == sorted(shares, reverse=True)
    assert shares[1:3] == pytest.approx([0.5**0.5, 0.5**0.9])


def test_a_sender_with_a_lower_rate_keeps_a_larger_queue_share() -> None:
    poor, rich = channel_share(4e5).queue_share(2e5, 0.0), channel_share(2e5).queue_share(4e5, 0.0)
    assert rich < poor <= MAX_SHARE


def test_idle_or_stale_senders_do_not_reduce_the_queue_share() -> None:
    assert channel_share(100.0, 200.0).queue_share(1e5, 0.0) == 1.0
    stopped = channel_share(1e5)
    stopped.on_send_rate(bytes([0]), 50.0, 1.0)
    assert stopped.queue_share(1e5, 1.0) == 1.0
    assert channel_share(1e5).queue_share(1e5, RATE_VALID_S + 1.0) == 1.0


def test_a_reported_send_rate_is_valid_until_the_next_heartbeat_is_overdue() -> None:
    made = ChannelShare()
    made.on_send_rate(b"0", 1e5, 0.0, valid_s=4 * RATE_VALID_S)
    assert made.queue_share(1e5, 3 * RATE_VALID_S) < 1.0
    assert made.queue_share(1e5, 4 * RATE_VALID_S + 1.0) == 1.0


def settled_queue(share: float, loss: float) -> float:
    """Packets beyond the path's own at which the window settles: 150 packets/s over 20 ms."""
    rtt = RttEstimator()
    window = DelayBasedController(rtt)
    window.queue_share = share
    now, base, rate = 0.0, 0.020, 150.0
    for number in range(4000):
        now += 1 / rate
        rtt.sample(max(base, window.cwnd / rate), now)
        in_flight = int(window.cwnd)
        window.on_ack(
            1,
            number,
            number + in_flight,
            in_flight,
            rate,
            app_limited=False,
            ahead=in_flight,
            lost=0,
            loss=loss,
            now=now,
        )
    return window.cwnd - base * rate


def test_the_queue_target_shrinks_on_a_shared_channel_unless_loss_is_high() -> None:
    alone = settled_queue(1.0, 0.0)
    assert alone >= MIN_QUEUE_PACKETS * 0.9
    assert settled_queue(0.5, 0.0) <= 0.6 * alone
    assert settled_queue(0.5, UNSHARED_FROM_LOSS) >= 0.9 * alone
