"""The windowed round trip: stalls of a radio that repeats a frame are no queue, a queue still shows at once."""

from udp_mesh.core.congestion.rtt import MAX_JITTER_WINDOW_S, MIN_WINDOWED_RTT_S, RttEstimator

BASE_S = 0.010


def estimator(stall_every: int, packet_s: float = 0.001) -> RttEstimator:
    """After ten seconds of samples, one each millisecond; a stall holds 25 of them back until it ends."""
    rtt = RttEstimator()
    rtt.packet_s = packet_s
    for number in range(10_000):
        left = 25 - number % stall_every if stall_every and number < 9_990 else 0
        rtt.sample(BASE_S + max(0, left) * 0.001, number * 0.001)
    return rtt


def stalled(rtt: RttEstimator, seconds: float) -> float:
    """The windowed RTT at the end of samples that are all long."""
    for number in range(int(seconds * 1000)):
        rtt.sample(BASE_S + 0.03, 10.0 + number * 0.001)
    assert rtt.windowed_rtt is not None
    return rtt.windowed_rtt


def test_without_jitter_a_queue_is_detected_within_the_shortest_window() -> None:
    assert stalled(estimator(0), MIN_WINDOWED_RTT_S + 0.003) > BASE_S + 0.02


def test_another_stall_on_a_jittery_path_is_not_taken_for_a_queue() -> None:
    assert stalled(estimator(50), 0.030) < BASE_S + 0.005


def test_a_persistent_queue_is_detected_despite_jitter() -> None:
    assert stalled(estimator(50), MAX_JITTER_WINDOW_S + 0.005) > BASE_S + 0.02


def test_packet_serialization_time_is_not_counted_as_jitter() -> None:
    assert stalled(estimator(50, packet_s=0.02), MIN_WINDOWED_RTT_S + 0.003) > BASE_S + 0.02


def test_a_restarted_smoothed_round_trip_is_that_of_the_next_sample() -> None:
    rtt = estimator(0)
    for number in range(20):
        rtt.sample(0.4, 10.0 + number * 0.001)
    assert rtt.smoothed_rtt is not None
    assert rtt.smoothed_rtt > 0.3
    rtt.restart_smoothed()
    rtt.sample(BASE_S, 10.1)
    assert (rtt.smoothed_rtt, rtt.rttvar, rtt.windowed_rtt) == (BASE_S, BASE_S / 2, BASE_S)
