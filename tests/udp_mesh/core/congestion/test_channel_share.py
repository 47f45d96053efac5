"""Several senders on one channel keep less queue each, and equal shares."""

from __future__ import annotations

from udp_mesh.core.congestion.channel_share import HOLDS_S, MOST_SHARE, Crowd
from udp_mesh.core.congestion.delay_based import LEAST_QUEUE_PACKETS, SHARED_UP_TO_LOSS, AdaptiveWindow
from udp_mesh.core.congestion.rtt import RoundTrip


def crowd(*rates: float) -> Crowd:
    made = Crowd()
    for number, rate in enumerate(rates):
        made.told(bytes([number]), rate, 0.0)
    return made


def test_a_single_sender_keeps_the_whole_queue_whatever_its_acknowledgements_take() -> None:
    assert crowd().queue_share(1e6, 0.0) == 1.0
    assert crowd(50_000.0).queue_share(1e6, 0.0) == 1.0


def test_the_more_senders_the_less_queue_each() -> None:
    shares = [crowd(*[3e5] * others).queue_share(3e5, 0.0) for others in (0, 1, 3, 7)]
    assert shares == sorted(shares, reverse=True)
    assert abs(shares[2] - 0.5) < 1e-9


def test_who_sends_less_than_the_others_keeps_more() -> None:
    poor, rich = crowd(4e5).queue_share(2e5, 0.0), crowd(2e5).queue_share(4e5, 0.0)
    assert rich < poor <= MOST_SHARE


def test_who_sends_next_to_nothing_or_was_not_heard_for_long_does_not_count() -> None:
    assert crowd(100.0, 200.0).queue_share(1e5, 0.0) == 1.0
    stopped = crowd(1e5)
    stopped.told(bytes([0]), 50.0, 1.0)
    assert stopped.queue_share(1e5, 1.0) == 1.0
    assert crowd(1e5).queue_share(1e5, HOLDS_S + 1.0) == 1.0


def test_in_a_large_team_what_was_said_holds_until_the_next_heartbeat_is_overdue() -> None:
    made = Crowd()
    made.told(b"0", 1e5, 0.0, holds_s=4 * HOLDS_S)
    assert made.queue_share(1e5, 3 * HOLDS_S) < 1.0
    assert made.queue_share(1e5, 4 * HOLDS_S + 1.0) == 1.0


def settled_queue(share: float, loss: float) -> float:
    """Packets above the path's own that the window settles at: 150 packets/s over 20 ms."""
    trip = RoundTrip()
    window = AdaptiveWindow(trip)
    window.queue_share = share
    now, base, rate = 0.0, 0.020, 150.0
    for number in range(4000):
        now += 1 / rate
        trip.sample(max(base, window.packets / rate), now)
        in_flight = int(window.packets)
        window.acknowledged(
            1, number, number + in_flight, in_flight, rate, limited=False, ahead=in_flight, loss=loss, now=now
        )
    return window.packets - base * rate


def test_a_shared_channel_needs_less_of_our_queue_unless_much_is_lost() -> None:
    alone = settled_queue(1.0, 0.0)
    assert alone >= LEAST_QUEUE_PACKETS * 0.9
    assert settled_queue(0.5, 0.0) <= 0.6 * alone
    assert settled_queue(0.5, SHARED_UP_TO_LOSS) >= 0.9 * alone
