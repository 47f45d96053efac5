"""A message whose lifetime was over when it arrived was not delivered, whatever arrives of it later."""

from __future__ import annotations

import pytest

from udp_mesh.core.receiver.reassembly import FragmentStatus, Reassembly
from udp_mesh.core.settings import Limits
from udp_mesh.wire.frames import Fragment, MessageHead


def first(fragments: int, life_ms: int) -> Fragment:
    return Fragment(7, 0, b"x" * 10, MessageHead(10 * fragments, fragments, 1, 3, 0, 0, life_ms))


@pytest.mark.parametrize("fragments", [1, 2])
def test_a_copy_of_an_expired_message_is_not_acknowledged(fragments: int) -> None:
    reassembly = Reassembly(Limits())
    assert reassembly.add(first(fragments, 200), 100.0, late_s=0.3) is FragmentStatus.EXPIRED
    assert reassembly.add(first(fragments, 150), 100.05, late_s=0.3) is FragmentStatus.EXPIRED
    if fragments > 1:
        assert reassembly.add(Fragment(7, 1, b"x" * 10, None), 100.1) is FragmentStatus.EXPIRED


def test_the_rest_of_a_message_that_expired_meanwhile_is_not_acknowledged() -> None:
    reassembly = Reassembly(Limits())
    assert reassembly.add(first(2, 200), 100.0) is FragmentStatus.KEPT
    reassembly.purge(100.3)
    assert reassembly.add(Fragment(7, 1, b"x" * 10, None), 100.3) is FragmentStatus.EXPIRED


def test_a_copy_of_a_delivered_message_is_acknowledged_although_its_lifetime_is_over() -> None:
    reassembly = Reassembly(Limits())
    assert not isinstance(reassembly.add(first(1, 200), 100.0), FragmentStatus)
    assert reassembly.add(first(1, 1), 100.3, late_s=0.3) is FragmentStatus.DUPLICATE
