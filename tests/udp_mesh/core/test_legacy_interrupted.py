"""Messages to a legacy robot that were interrupted: it discards what it acknowledged ten seconds before."""

import pytest

from tests.udp_mesh.core.legacy_program import LegacyProgram
from tests.udp_mesh.core.test_legacy import OldRobot
from udp_mesh.core.events import MessageDelivered
from udp_mesh.wire.legacy import Host, LegacyPayload

BODY = bytes(8000)


class Exchange:
    """Our node, and a legacy program that takes what our node sends."""

    def __init__(self) -> None:
        self.old = OldRobot()
        self.program = LegacyProgram()
        self.taken: list[bytes] = []

    def turn(self, *, arrive: bool = True, acks: bool = True) -> None:
        """Exchange what is sent now, then let 10 ms pass."""
        fragments = [one for one in self.old.hear() if isinstance(one, LegacyPayload)]
        for fragment in fragments if arrive else ():
            ack, message = self.program.on_fragment(fragment, self.old.now)
            if acks:
                self.old.say(ack)
            if message is not None:
                self.taken.append(message.data)
        self.program.prune(self.old.now)
        self.old.now += 0.01

    def pause(self, seconds: float, *, heartbeats: bool = True) -> None:
        """Nothing that our node sends arrives."""
        end = self.old.now + seconds
        while self.old.now < end:
            self.turn(arrive=False)
            if heartbeats and round(self.old.now * 100) % 100 == 0:
                self.old.say(Host("old", "10.0.0.9"))

    def finish(self) -> None:
        """Until our node has an outcome."""
        self.old.say(Host("old", "10.0.0.9"))
        for _ in range(1000):
            self.turn()
            if any(isinstance(event, MessageDelivered) for event in self.old.events()):
                return
        raise AssertionError("no outcome within 10 s")


@pytest.mark.parametrize("heartbeats", [True, False])
@pytest.mark.parametrize("pause_s", [1.0, 7.5, 9.0, 12.0, 25.0])
def test_a_message_that_an_outage_interrupts_is_complete_when_it_is_delivered(pause_s: float, heartbeats: bool) -> None:
    exchange = Exchange()
    exchange.old.node.send("map", BODY, destination="old", now=exchange.old.now)
    exchange.turn()
    exchange.pause(pause_s, heartbeats=heartbeats)
    exchange.finish()
    assert exchange.taken == [BODY]


def test_a_message_that_urgent_ones_hold_up_is_complete_when_it_is_delivered() -> None:
    exchange = Exchange()
    exchange.old.node.send("map", BODY, destination="old", now=exchange.old.now)
    exchange.turn()
    for _ in range(1200):
        exchange.old.node.send("stop", bytes(8000), destination="old", now=exchange.old.now)
        exchange.turn()
        exchange.old.events()
    for _ in range(20_000):
        exchange.turn()
        if exchange.taken[-1] == BODY and not exchange.old.node.conditions(exchange.old.now).queued_bytes:
            break
    assert exchange.taken.count(BODY) == 1201


@pytest.mark.parametrize("late_s", [9.0, 17.0])
def test_a_message_that_a_suspended_process_interrupts_is_complete_when_it_is_delivered(late_s: float) -> None:
    """The acknowledgments wait in the socket of our computer, and are taken for new ones."""
    exchange = Exchange()
    exchange.old.node.send("map", BODY, destination="old", now=exchange.old.now)
    exchange.turn()
    fragments = [one for one in exchange.old.hear() if isinstance(one, LegacyPayload)]
    acks = [exchange.program.on_fragment(fragment, exchange.old.now)[0] for fragment in fragments]
    exchange.old.now += late_s
    exchange.program.prune(exchange.old.now)
    for ack in acks:
        exchange.old.say(ack)
    exchange.finish()
    assert exchange.taken == [BODY]


def test_a_message_that_is_complete_is_not_sent_again_after_a_pause() -> None:
    exchange = Exchange()
    exchange.old.node.send("map", BODY, destination="old", now=exchange.old.now)
    while not exchange.taken:
        exchange.turn()
    exchange.pause(20.0)
    exchange.old.events()
    for _ in range(200):
        exchange.turn()
    assert exchange.taken == [BODY]
