"""Logs beside nodes without them, and beside key holders that lie."""

from __future__ import annotations

import random

from tests.udp_mesh.core.logs.team import ARTIFACT, LogTeam
from tests.udp_mesh.core.pair import settings
from udp_mesh.core.events import MessageDelivered, MessageReceived, Rejected, RejectReason
from udp_mesh.core.logs.item import ItemId, LogItem, LogKey, encode_item
from udp_mesh.core.logs.messages import CONTROL_TOPIC, Have, HaveEntry, ItemRequest, encode_control, item_topic
from udp_mesh.core.settings import Topic
from udp_mesh.crypto.signing import SigningKey


def test_a_reader_without_logs_gets_items_published_while_it_is_online() -> None:
    team = LogTeam("spot")
    team.add(settings("base", Topic("artifact")))
    team.connect("base", "spot")
    team.run(3)
    message = team.publish("spot", b"artifact")
    team.run(2)
    assert [(source, payload) for source, _, payload in team.read("base")] == [("spot", b"artifact")]
    delivered = [event for event in team.events_of("spot", MessageDelivered) if isinstance(event, MessageDelivered)]
    assert [(event.message_id, event.peer) for event in delivered] == [(message, "base")]


def test_a_node_with_logs_gets_plain_messages_of_one_without() -> None:
    team = LogTeam("base")
    team.add(settings("spot", Topic("artifact")))
    team.connect("base", "spot")
    team.run(3)
    team.send("spot", "artifact", b"plain", "base")
    team.run(2)
    assert team.read("base") == [("spot", None, b"plain")]


def test_a_log_has_no_destinations() -> None:
    team = LogTeam("base", "spot")
    result = team.send("spot", "artifact", b"x", "base")
    assert isinstance(result, Rejected)
    assert result.reason is RejectReason.UNKNOWN_PEER
    assert "its items go to its readers" in result.detail


def test_a_topic_becomes_a_log_at_run_time() -> None:
    team = LogTeam("base", "husky", "spot", topics=())
    for name in ("spot", "husky", "base"):
        changes = team.nodes[name].apply(settings(name, ARTIFACT), team.now)
        assert changes == ["topic artifact: added"]
    team.run(1)
    team.publish("spot", b"artifact")
    team.meet("spot", "husky", seconds=6)
    team.meet("husky", "base", seconds=6)
    assert team.read("base") == [("spot", 1, b"artifact")]


class Liar(LogTeam):
    """`base` beside `mallory`, which has the fleet's key and sends whatever it likes."""

    def __init__(self) -> None:
        super().__init__("base")
        self.add(settings("mallory", Topic("artifact")))
        self.connect("base", "mallory")
        self.run(3)

    def submit(self, topic: str, payload: bytes) -> None:
        self.send("mallory", topic, payload, "base")
        self.run(0.5)


def test_forged_items_are_refused() -> None:
    team = Liar()
    key = SigningKey(bytes(32))
    item = LogItem(ItemId(LogKey("artifact", "spot", key.public), 1), 0, "", b"forged")
    signed = encode_item(key, item)
    for data in (
        b"",
        b"\1",
        signed[:-1],
        signed + b"!",
        bytes([signed[0] ^ 1]) + signed[1:],
        random.Random(1).randbytes(200),
    ):
        team.submit(item_topic("artifact"), data)
    team.submit(item_topic("unknown"), signed)
    assert team.read("base") == []
    assert team.stores["base"].items == {}


def test_invented_numbers_cost_little_and_block_nothing() -> None:
    team = Liar()
    log = LogKey("artifact", "spot", bytes(32))
    everything = encode_control(Have((HaveEntry(log, ((1, (1 << 32) - 1),)),), complete=True))
    for _ in range(50):
        team.submit(CONTROL_TOPIC, everything)
        team.submit(CONTROL_TOPIC, encode_control(ItemRequest(((log, ((1, 4_000_000_000),)),))))
    team.start("spot")
    team.connect("base", "spot")
    team.publish("spot", b"real")
    team.run(5)
    assert [payload for _, _, payload in team.read("base")] == [b"real"]


def test_random_control_messages_are_counted() -> None:
    team = Liar()
    rng = random.Random(2)
    for _ in range(40):
        team.submit(CONTROL_TOPIC, bytes((rng.choice((1, 2)),)) + rng.randbytes(rng.randint(0, 60)))
    assert list(team.events_of("base", MessageReceived)) == []
