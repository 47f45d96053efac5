"""An acknowledgment is late once a sender with a small window has requested another one."""

import pytest

from udp_mesh.core.receiver.memory_limit import MemoryBudget
from udp_mesh.core.receiver.receiver import Receiver
from udp_mesh.core.settings import Limits, Rates


@pytest.mark.parametrize(
    ("packets", "every", "late"),
    [(4, 4, False), (4, 2, True), (7, 4, False), (8, 4, True), (30, 10, False), (2, 1, True), (3, 9, False)],
)
def test_an_acknowledgment_is_late_once_a_small_window_has_requested_another(
    packets: int, every: int, *, late: bool
) -> None:
    receiver = Receiver(Rates(), Limits(), MemoryBudget(1 << 20))
    for number in range(packets):
        receiver.on_accepted(number, 0.0, ack_now=(number + 1) % every == 0)
    assert receiver.acks.is_late is late
    receiver.acks.on_ack_sent()
    assert not receiver.acks.is_late
