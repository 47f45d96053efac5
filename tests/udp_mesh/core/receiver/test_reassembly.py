"""What reassembly holds, refuses and forgets, fragment by fragment."""

import pytest

from udp_mesh.core.receiver.memory_limit import PARTIAL_BYTES, Account, MemoryBudget
from udp_mesh.core.receiver.reassembly import (
    BEST_EFFORT_TIMEOUT_S,
    MAX_EXPIRED_REMEMBERED,
    RELIABLE_TIMEOUT_S,
    FragmentStatus,
    Reassembly,
)
from udp_mesh.core.settings import Limits
from udp_mesh.wire.frames import Fragment, MessageFlag, MessageHead


def head(size_bytes: int, fragments: int, *, life_ms: int | None = None) -> MessageHead:
    return MessageHead(size_bytes, fragments, 1, 5, MessageFlag.RELIABLE, 0, life_ms)


def begun(size_bytes: int, fragments: int, *, limits: Limits | None = None) -> Reassembly:
    """Message 7 with its first fragment of 3 bytes."""
    reassembly = Reassembly(limits or Limits())
    assert reassembly.add(Fragment(7, 0, b"abc", head(size_bytes, fragments)), 0.0) is FragmentStatus.KEPT
    return reassembly


@pytest.mark.parametrize(
    ("position", "payload"), [(1, bytes(8)), (4, b"x"), (1 << 20, b"x")], ids=["too long", "next", "far"]
)
def test_a_plain_fragment_that_contradicts_the_head_is_corrupt(position: int, payload: bytes) -> None:
    reassembly = begun(10, 4)
    assert not reassembly.add_plain(7, position, payload)
    assert reassembly.add(Fragment(7, position, payload), 0.0) is FragmentStatus.CORRUPT


def test_a_plain_fragment_beyond_the_memory_limit_is_refused() -> None:
    reassembly = begun(5000, 4, limits=Limits(partial_bytes_per_peer=1000))
    assert not reassembly.add_plain(7, 1, bytes(900))
    assert reassembly.add(Fragment(7, 1, bytes(900)), 0.0) is FragmentStatus.FULL


def test_a_head_that_contradicts_an_earlier_position_is_corrupt() -> None:
    reassembly = Reassembly(Limits())
    assert reassembly.add(Fragment(7, 4, b"x"), 0.0) is FragmentStatus.KEPT
    assert reassembly.add(Fragment(7, 0, b"abc", head(100, 4)), 0.0) is FragmentStatus.CORRUPT


def test_a_message_that_is_complete_only_after_its_lifetime_is_not_delivered() -> None:
    reassembly = Reassembly(Limits())
    reassembly.add(Fragment(7, 0, b"abc", head(4, 2, life_ms=100)), 0.0)
    assert reassembly.add(Fragment(7, 1, b"d"), 0.2) is FragmentStatus.EXPIRED


def test_a_reliable_message_waits_for_minutes_and_is_then_requested_again() -> None:
    reassembly = begun(10, 4)
    reassembly.purge(0.0)
    reassembly.purge(BEST_EFFORT_TIMEOUT_S + 1)
    assert len(reassembly) == 1
    reassembly.purge(RELIABLE_TIMEOUT_S + 1)
    assert len(reassembly) == 0
    assert reassembly.add(Fragment(7, 1, b"x"), RELIABLE_TIMEOUT_S + 2) is FragmentStatus.FORGOTTEN


def test_what_was_reserved_for_a_message_is_released_with_it() -> None:
    account = Account(MemoryBudget(1 << 30))
    reassembly = Reassembly(Limits(), account)
    reassembly.add(Fragment(7, 0, b"abc", head(10, 4)), 0.0)
    assert account.bytes > 0
    reassembly.forget(7)
    assert account.bytes == 0


def test_where_no_whole_step_is_left_a_fragment_takes_what_it_needs() -> None:
    memory = MemoryBudget(100_000)
    reassembly = Reassembly(Limits(), Account(memory))
    payload = bytes(10_000)
    results = [reassembly.add(Fragment(1, place, payload, None), 0.0) for place in range(1, 11)]
    kept = results.count(FragmentStatus.KEPT)
    assert 0 < kept < 10
    assert results[kept:] == [FragmentStatus.FULL] * (10 - kept)
    assert memory.bytes == PARTIAL_BYTES + reassembly.bytes <= 50_000
    assert memory.bytes + len(payload) > 50_000
    reassembly.forget(1)
    assert memory.bytes == 0


def test_only_so_many_expired_messages_are_remembered() -> None:
    reassembly = Reassembly(Limits())
    for message_id in range(MAX_EXPIRED_REMEMBERED + 1):
        fragment = Fragment(message_id, 0, b"abc", head(4, 2, life_ms=100))
        assert reassembly.add(fragment, 1.0, late_s=5.0) is FragmentStatus.EXPIRED
    assert reassembly.add(Fragment(0, 1, b"d"), 1.0) is FragmentStatus.DUPLICATE
    assert reassembly.add(Fragment(1, 1, b"d"), 1.0) is FragmentStatus.EXPIRED
