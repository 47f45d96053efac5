"""A message is complete once: whatever of it comes again, in whichever order, is a duplicate."""

from __future__ import annotations

import itertools

import pytest

from udp_mesh.core.receiver.reassembly import CompleteMessage, FragmentStatus, Reassembly
from udp_mesh.core.settings import Limits
from udp_mesh.wire.frames import Fragment, MessageHead


@pytest.mark.parametrize("order", list(itertools.permutations(range(3))))
def test_fragments_of_a_complete_message_are_duplicates(order: tuple[int, ...]) -> None:
    head = MessageHead(30, 3, 1, 5, 1, 0)
    fragments = [Fragment(4, place, bytes([place]) * 10, None if place else head) for place in range(3)]
    reassembly = Reassembly(Limits())
    results = [reassembly.add(fragments[place], 1.0) for place in order]
    assert results[:2] == [FragmentStatus.KEPT] * 2
    assert isinstance(results[2], CompleteMessage)
    for _ in range(2):
        assert [reassembly.add(fragments[place], 1.0) for place in order] == [FragmentStatus.DUPLICATE] * 3
    assert reassembly.bytes == len(reassembly) == 0
