"""Messages that have ended are forgotten, even if their peer can never be sent anything."""

from __future__ import annotations

import random
import tracemalloc

import pytest

from udp_mesh.core.endpoint import Endpoint
from udp_mesh.core.events import MessageId
from udp_mesh.core.sender.message import AcceptedMessage, OutgoingMessage, TopicChannel
from udp_mesh.core.sender.scheduler import MIN_PURGE_MESSAGES, Scheduler
from udp_mesh.core.settings import LinkInfo, LinkKind, Settings, Topic
from udp_mesh.crypto import Key

MESSAGES, MESSAGE_BYTES, MAX_HELD_MESSAGES = 400, 20_000, 100


@pytest.mark.parametrize(
    "topic",
    [
        Topic("video", priority=9, destinations=("base",)),
        Topic("video", priority=9, destinations=("base",), reliable=False, keep_last=2, deadline_s=0.5),
        Topic("video", priority=9, destinations=("base",), delta=True),
        Topic("video", priority=0, destinations=("base",), rate_limit_bytes_per_s=1000),
    ],
    ids=["reliable", "best effort", "differences", "limited"],
)
def test_messages_to_a_destination_that_was_never_heard_are_not_held(topic: Topic) -> None:
    settings = Settings("robot", keys=(Key(bytes(32)),), topics=(topic,))
    node = Endpoint(settings, boot_id=bytes(16), rng=random.Random(1), now=0.0)
    node.link_up(LinkInfo("wlan0", LinkKind.BROADCAST, ("10.0.0.1", 8700), ("10.0.0.255", 8700), 1500), 0.0)
    tracemalloc.start()
    for number in range(MESSAGES):
        now = number * 0.1
        assert isinstance(node.send("video", bytes(MESSAGE_BYTES), now=now), int)
        node.handle_timer(now)
        node.datagrams_to_send(now)
        while node.next_event() is not None:
            pass
    held_bytes, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert held_bytes < MAX_HELD_MESSAGES * MESSAGE_BYTES


def test_a_level_forgets_replaced_messages_that_nothing_takes_out() -> None:
    topic = Topic("pose", priority=3)
    channel = TopicChannel(0, topic, topic.name, "")
    scheduler = Scheduler()
    waiting: list[OutgoingMessage] = []
    for number in range(20 * MIN_PURGE_MESSAGES):
        for replaced in waiting:
            replaced.ended = True
        accepted = AcceptedMessage(MessageId(number), channel, b"x", b"x", 0, 0.0, None)
        message = OutgoingMessage(accepted, 3, reliable=True)
        waiting = [message]
        scheduler.push(message)
        assert len(scheduler._levels[3].fresh) <= MIN_PURGE_MESSAGES
    run = scheduler.peek(3)
    assert run is not None
    assert run.message is waiting[0]
