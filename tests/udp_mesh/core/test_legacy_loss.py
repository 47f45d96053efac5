"""A legacy peer on a link that loses a fifth each way: urgent messages keep overtaking, bulk keeps moving."""

import heapq
import random

import pytest

from tests.udp_mesh.core.legacy_program import LegacyProgram
from tests.udp_mesh.core.test_legacy import OldRobot, fragments
from udp_mesh.core.events import Event, MessagePeerLost, PeerOffline
from udp_mesh.core.settings import Rates
from udp_mesh.wire.legacy import LegacyAck, LegacyPayload, decode_mesh_data

DELAY_S, LOSS, TICK_S = 0.010, 0.2, 0.001


def play(seed: int, duration_s: float) -> tuple[list[float], int]:
    """Latencies in seconds of urgent messages (ten a second) beside endless bulk, and the bulk fragments that
    arrived."""
    rng, old, program = random.Random(seed), OldRobot(), LegacyProgram()
    started = old.now
    back: list[tuple[float, int, int]] = []
    sent_at: dict[bytes, float] = {}
    took: dict[bytes, float] = {}
    bulk: set[tuple[int, int]] = set()
    tick = 0
    while old.now < started + duration_s:
        if tick % 100 == 0:
            name = b"%d" % tick
            sent_at[name] = old.now
            old.node.send("stop", name, destination="old", now=old.now)
        if tick % 1000 == 0:
            old.node.send("map", bytes(200_000), destination="old", now=old.now)
        while back and back[0][0] <= old.now:
            _, sequence, position = heapq.heappop(back)
            old.say(LegacyAck(sequence, position))
        for fragment in old.hear():
            if not isinstance(fragment, LegacyPayload) or rng.random() < LOSS:
                continue
            _, message = program.on_fragment(fragment, old.now)
            if message is not None and message.topic == "stop":
                took.setdefault(message.data, old.now + DELAY_S - sent_at[message.data])
            elif fragment.total > 2:
                bulk.add((fragment.sequence, fragment.position))
            if rng.random() >= LOSS:
                heapq.heappush(back, (old.now + 2 * DELAY_S, fragment.sequence, fragment.position))
        old.events()
        tick += 1
        old.now += TICK_S
    return sorted(took.values()), len(bulk)


def test_urgent_messages_and_bulk_to_a_legacy_peer_survive_twenty_percent_loss() -> None:
    took, bulk = play(5, 40.0)
    assert len(took) >= 395
    assert took[len(took) * 99 // 100] <= 0.35
    assert bulk >= 1500


def test_a_legacy_peer_that_answered_and_fell_silent_is_probed_gently() -> None:
    old = OldRobot()
    old.node.send("map", bytes(50_000), destination="old", now=old.now)
    for turn in range(12):
        old.now += 0.010
        for place, fragment in enumerate(old.hear()):
            # One of three never arrives.
            if isinstance(fragment, LegacyPayload) and (turn + place) % 3:
                old.say(LegacyAck(fragment.sequence, fragment.position))
    silent_from, left = old.now + 2.0, 0
    while old.now < silent_from + 10.0:
        old.now += 0.010
        fragments = [fragment for fragment in old.hear() if isinstance(fragment, LegacyPayload)]
        left += len(fragments) if old.now > silent_from else 0
    assert 30 <= left <= 60


def test_after_a_loss_acknowledgements_are_repeated_once_more_for_ten_seconds() -> None:
    old = OldRobot()

    def acknowledgements(fragment: LegacyPayload) -> int:
        """How often this fragment is acknowledged within a second."""
        old.say(fragment)
        found = 0
        for _ in range(100):
            found += old.hear().count(LegacyAck(fragment.sequence, fragment.position))
            old.now += 0.01
        return found

    first, _, third, _ = fragments(5, bytes(4000))
    old.say(first)
    old.say(third)
    old.now += 8.0
    assert acknowledgements(fragments(6, b"x")[0]) == 3
    old.now += 3.0
    assert acknowledgements(fragments(7, b"x")[0]) == 2


@pytest.mark.parametrize("late_s", [0.001, 0.02, 0.049, 0.3, 30.0])
def test_a_timer_that_comes_late_is_not_due_again_at_once(late_s: float) -> None:
    """On a busy computer the last prediction after a message may come after the time for which there are any: the timer
    stayed in the past, and the daemon ran in circles until the next message."""
    for shift in range(50):
        old = OldRobot()
        old.say(fragments(5, b"x")[0])
        old.now += 0.001 * shift
        old.say(fragments(6, b"x")[0])
        end = old.now + 3.0
        while old.now < end:
            # Checks that the next timer is later.
            old.hear()
            due = old.node.next_timer()
            assert due is not None
            old.now = due + late_s


def test_what_waits_for_a_legacy_robot_that_is_lost_ends() -> None:
    old = OldRobot(rates=Rates(offline_s=3.0, peer_lost_s=6.0))
    old.node.send("map", b"x", destination="old", now=old.now)
    found: list[Event] = []
    for _ in range(80):
        old.hear()
        found += old.events()
        old.now += 0.1
    assert [type(event) for event in found] == [PeerOffline, MessagePeerLost]


def test_the_next_timer_is_that_of_the_fragment_that_waits_longest() -> None:
    old = OldRobot()
    sent: list[int] = []
    for _ in range(2):
        old.node.send("map", b"x", destination="old", now=old.now)
        sent += {fragment.sequence for fragment in old.hear_payloads()}
        old.now += 0.1
    at = old.node.next_timer()
    assert at is not None
    old.now = at
    assert {fragment.sequence for fragment in old.hear_payloads()} == {sent[0]}


def test_messages_to_a_legacy_robot_are_numbered_in_their_header() -> None:
    old = OldRobot()
    numbers = []
    for _ in range(3):
        old.node.send("map", b"x", destination="old", now=old.now)
        (fragment,) = old.hear_messages()
        old.say(LegacyAck(fragment.sequence, 0))
        old.say(LegacyAck(fragment.sequence, 1))
        numbers.append(decode_mesh_data(fragment.data).sequence)
    assert numbers == [1, 2, 3]
