"""The small parts against simple slow models: ranges, packets in flight, reassembly, compression, acknowledgments,
buckets."""

import zlib
from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from tests.udp_mesh.core.sender.test_scheduler import outgoing
from udp_mesh.core.compression import compress, decompress
from udp_mesh.core.congestion.pacer import MAX_DEBT_S, Pacer
from udp_mesh.core.ranges import RangeSet
from udp_mesh.core.receiver.acks import AckState
from udp_mesh.core.receiver.reassembly import FRAGMENT_OVERHEAD_BYTES, CompleteMessage, FragmentStatus, Reassembly
from udp_mesh.core.sender.rate_limit import TokenBucket
from udp_mesh.core.sender.sent_packets import Packet, SendSnapshot, SentPackets
from udp_mesh.core.settings import Limits
from udp_mesh.wire.frames import Fragment, MessageFlag, MessageHead

RELIABLE = int(MessageFlag.RELIABLE)


@given(st.lists(st.integers(0, 60)))
def test_a_range_set_equals_a_plain_set(numbers: list[int]) -> None:
    ranges, plain = RangeSet(), set()
    for number in numbers:
        ranges.add(number)
        plain.add(number)
    assert [number in ranges for number in range(62)] == [number in plain for number in range(62)]
    pairs = ranges.ranges()
    assert all(first <= last for first, last in pairs)
    assert all(before[1] + 1 < after[0] for before, after in pairwise(pairs))


@given(
    st.lists(st.tuples(st.integers(0, 60), st.integers(0, 12))),
    st.lists(st.tuples(st.integers(0, 60), st.integers(0, 12))),
)
def test_ranges_of_a_range_set_equal_plain_sets(one: list[tuple[int, int]], other: list[tuple[int, int]]) -> None:
    sets = []
    for pieces in (one, other):
        ranges = RangeSet()
        plain: set[int] = set()
        for first, length in pieces:
            ranges.add_range(first, first + length - 1)
            plain.update(range(first, first + length))
        assert {number for number in range(80) if number in ranges} == plain
        assert ranges.count == len(plain)
        assert all(before[1] + 1 < after[0] for before, after in pairwise(ranges.ranges()))
        sets.append((ranges, plain))
    (left, plain_left), (right, plain_right) = sets
    missing = left.without(right)
    assert {number for first, last in missing for number in range(first, last + 1)} == plain_left - plain_right
    assert all(first <= last for first, last in missing)


def fragments_of(body: bytes, size: int, message_id: int = 1) -> list[Fragment]:
    chunks = [body[start : start + size] for start in range(0, len(body), size)] or [b""]
    head = MessageHead(len(body), len(chunks), 0, 3, RELIABLE)
    return [
        Fragment(message_id, position, chunk, head if position == 0 else None) for position, chunk in enumerate(chunks)
    ]


@given(st.binary(max_size=400), st.integers(1, 50), st.data())
def test_reassembly_does_not_depend_on_order_or_repetition(body: bytes, size: int, data: st.DataObject) -> None:
    fragments = fragments_of(body, size)
    order = data.draw(st.permutations(fragments + fragments[: len(fragments) // 2]))
    reassembly = Reassembly(Limits())
    results = [reassembly.add(fragment, 0.0) for fragment in order]
    wholes = [result for result in results if isinstance(result, CompleteMessage)]
    assert [whole.body for whole in wholes] == [body]
    assert set(results) - set(wholes) <= {FragmentStatus.KEPT, FragmentStatus.DUPLICATE}
    assert reassembly.bytes == 0


fragments = st.builds(
    Fragment,
    st.integers(0, 5),
    st.integers(0, 2_000_000),
    st.binary(min_size=1, max_size=30),
    st.none()
    | st.builds(MessageHead, st.integers(0, 1 << 30), st.integers(1, 1 << 21), st.just(0), st.just(0), st.just(0)),
)


@given(st.lists(fragments, max_size=60))
def test_reassembly_never_holds_more_than_its_cap_whatever_fragments_claim(claims: list[Fragment]) -> None:
    limits = Limits(partial_bytes_per_peer=600, message_bytes=100, partials_per_peer=3, finished_ranges_per_peer=4)
    reassembly = Reassembly(limits)
    for now, fragment in enumerate(claims):
        reassembly.add(fragment, float(now))
        assert reassembly.bytes <= limits.partial_bytes_per_peer
        assert len(reassembly) <= limits.partials_per_peer
        assert len(reassembly.finished) <= limits.finished_ranges_per_peer


def test_a_refused_fragment_leaves_nothing_behind_and_is_taken_when_there_is_room() -> None:
    reassembly = Reassembly(Limits(partial_bytes_per_peer=FRAGMENT_OVERHEAD_BYTES + 50))
    first, second = fragments_of(bytes(60), 30)
    assert reassembly.add(first, 0.0) is FragmentStatus.KEPT
    other = Fragment(2, 1, bytes(30))
    assert reassembly.add(other, 0.0) is FragmentStatus.FULL
    assert len(reassembly) == 1
    assert reassembly.add(second, 0.0) is FragmentStatus.FULL
    reassembly.forget(1)
    assert reassembly.add(other, 0.0) is FragmentStatus.KEPT


def test_an_incomplete_best_effort_message_is_purged_by_its_own_age() -> None:
    reassembly = Reassembly(Limits())
    head = MessageHead(100, 2, 0, 3, 0)
    reassembly.add(Fragment(1, 0, bytes(50), head), 0.0)
    reassembly.purge(0.0)
    reassembly.add(Fragment(2, 0, bytes(50), head), 2.5)
    reassembly.purge(2.5)
    assert len(reassembly) == 1
    late = reassembly.add(Fragment(2, 1, bytes(50)), 2.5)
    assert isinstance(late, CompleteMessage)


MARK = SendSnapshot(0.0, 0, 0.0, 0.0, False)


@given(
    st.lists(
        st.tuples(st.sampled_from(["send", "skip", "arrive", "ack", "give up"]), st.integers(0, 400)), max_size=120
    )
)
def test_packet_outcomes_match_a_simple_model(plan: list[tuple[str, int]]) -> None:
    in_flight, state = SentPackets(), AckState()
    sent: dict[int, Packet] = {}
    ended: dict[int, str] = {}
    number = 0

    def book(packets: list[Packet], how: str) -> None:
        for packet in packets:
            index = packet.position
            # Only a packet declared lost may change its outcome, once.
            assert index not in ended or (ended[index], how) == ("lost", "acknowledged")
            ended[index] = how

    for what, choice in plan:
        if what == "send":
            sent[number] = Packet(MARK, outgoing(1, 1), number)
            in_flight.add(number, sent[number])
            number += 1
        elif what == "skip":
            in_flight.add(number, None)
            number += 1
        elif what == "arrive" and number:
            state.on_packet(number - 1 - choice % min(number, 12), 0.0) if not received(
                state, number - 1 - choice % min(number, 12)
            ) else None
        elif what == "ack" and state.largest >= 0:
            acknowledged, lost, _ = in_flight.acknowledge(state.largest, state.received)
            book(acknowledged, "acknowledged")
            book(lost, "lost")
        elif what == "give up":
            book(in_flight.abandon_all(), "lost")
        assert in_flight.outstanding == sum(1 for index in sent if index not in ended)
    for index, how in ended.items():
        if how == "acknowledged":
            assert received(state, index)


URGENT = SendSnapshot(0.0, 0, 0.0, 0.0, False, urgent=True)


def test_urgent_packets_overtaking_bulk_do_not_indicate_loss() -> None:
    in_flight = SentPackets()
    bulk = [Packet(MARK, outgoing(1, 1), 0), Packet(MARK, outgoing(1, 1), 1)]
    for number in range(2):
        in_flight.add(number, bulk[number])
    for number in range(2, 8):
        in_flight.add(number, Packet(URGENT, outgoing(1, 1), number))
    acknowledged, lost, _ = in_flight.acknowledge(7, 0b111111)
    assert len(acknowledged) == 6
    assert lost == []
    # Three later ones of the same kind declare it lost.
    for number in range(8, 12):
        in_flight.add(number, Packet(MARK, outgoing(1, 1), number))
    assert in_flight.acknowledge(11, 0b1111111111)[1] == bulk


def test_a_lost_urgent_packet_is_detected_from_later_urgent_packets() -> None:
    in_flight = SentPackets()
    for number in range(5):
        in_flight.add(number, Packet(URGENT, outgoing(1, 1), number))
    assert [packet.position for packet in in_flight.acknowledge(4, 0b1111)[1]] == [0]


def test_timed_out_urgent_packets_count_as_lost_once_an_acknowledgement_confirms_it() -> None:
    in_flight = SentPackets()
    for number in range(8):
        in_flight.add(number, Packet(URGENT, outgoing(1, 1), number))
        in_flight.declare_lost_before(1.0)
    # 0, 2, 4 and 6 arrived; for 5 and 7 it is too early.
    assert in_flight.confirm_timed_out(7, 0b10101010) == 2
    assert in_flight.confirm_timed_out(7, 0b10101010) == 0


def received(state: AckState, number: int) -> bool:
    behind = state.largest - number
    return behind >= 0 and bool(state.received >> behind & 1)


def test_an_acknowledgement_of_unsent_packets_is_ignored() -> None:
    in_flight = SentPackets()
    in_flight.add(0, Packet(MARK, outgoing(1, 1), 0))
    assert in_flight.acknowledge(7, 0xFF) == ([], [], None)
    assert in_flight.outstanding == 1


@given(st.binary(max_size=2000))
def test_decompression_inverts_compression(payload: bytes) -> None:
    packed = compress(payload)
    if packed is not None:
        assert len(packed) < len(payload)
        assert decompress(packed, len(payload)) == payload


def test_a_compressed_bomb_is_refused_without_being_inflated() -> None:
    bomb = zlib.compress(bytes(50_000_000))
    assert decompress(bomb, 1_000_000) is None


@given(st.binary(max_size=200))
def test_anything_that_is_not_zlib_is_refused(body: bytes) -> None:
    result = decompress(body, 1000)
    assert result is None or zlib.compress(result)


def test_pacing_debt_from_a_slow_path_is_bounded_on_a_fast_one() -> None:
    pacer, now = Pacer(0.003), 10.0
    # Ten bursts to an unresponsive peer, when a packet took ten seconds.
    for _ in range(10):
        pacer.on_sent(10, now, 0.1)
    assert pacer.packets_allowed(now, 0.1) == 0
    assert pacer.wake_at(0.1) <= now + 10.0
    assert pacer.packets_allowed(now, 100.0) == 0
    assert pacer.wake_at(100.0) <= now + MAX_DEBT_S
    assert pacer.packets_allowed(now + MAX_DEBT_S, 100.0) == 1


@given(st.lists(st.tuples(st.floats(0.0, 0.5), st.integers(1, 3000)), max_size=50))
def test_a_token_bucket_never_exceeds_its_rate_and_burst(visits: list[tuple[float, int]]) -> None:
    bucket, now, spent = TokenBucket(10_000, 0.0), 0.0, 0
    for wait, size in visits:
        now += wait
        if bucket.has_tokens(now):
            bucket.consume(size)
            spent += size
    assert spent <= 10_000 * now + 1000 + 3000


def test_pacing_spreads_packets_over_time_at_its_rate() -> None:
    pacer, now, left = Pacer(0.003), 0.0, 0
    while now < 1.0:
        count = pacer.packets_allowed(now, 850.0)
        pacer.on_sent(count, now, 850.0)
        left += count
        now = max(now + 1e-9, pacer.wake_at(850.0))
    assert 845 <= left <= 856
