"""`meshctl meter --deploy`: a beacon is dropped once, and a message that cannot be sent is said before it is needed."""

from __future__ import annotations

from typing import Any

import pytest

from meshctl.cli.beacon_drop import TOPIC, BeaconDrop
from meshctl.errors import InputError
from meshctl.placement.meter import Advice
from meshctl.robots.local_daemon import DaemonError


class Daemon:
    """Answers with `topics`, or raises `error`."""

    def __init__(self, *topics: str, undeclared: object = None) -> None:
        self.reply: dict[str, Any] = {"topics": [{"name": name} for name in topics], "undeclared": undeclared}
        self.error: DaemonError | None = None
        self.sent: list[tuple[str, object]] = []

    def request(self, op: str, payload: bytes = b"", **fields: object) -> dict[str, Any]:
        if self.error is not None:
            raise self.error
        if op == "publish":
            self.sent.append((str(fields["topic"]), fields["to"]))
        return self.reply


def test_only_a_known_kind_is_accepted() -> None:
    with pytest.raises(InputError, match="expected ros1 or ros2, found 'ros3'"):
        BeaconDrop(Daemon(), "spot1", "ros3")


def test_what_could_not_be_sent_is_said_at_the_start() -> None:
    daemon = Daemon("estop")
    with pytest.raises(InputError, match="the daemon has no topic deploy_beacon") as missing:
        BeaconDrop(daemon, "spot1", "ros1").check()
    assert "the inventory's topics" in missing.value.hint
    daemon.error = DaemonError("/run/udp-mesh.sock: No such file or directory")
    with pytest.raises(InputError, match="--deploy needs the udp_mesh daemon of this machine: /run"):
        BeaconDrop(daemon, "spot1", "ros1").check()
    BeaconDrop(Daemon("estop", TOPIC), "spot1", "ros1").check()
    BeaconDrop(Daemon("estop", undeclared={"priority": 5}), "spot1", "ros2").check()


def test_one_message_is_sent_whenever_the_advice_becomes_drop_now() -> None:
    daemon = Daemon(TOPIC)
    drop = BeaconDrop(daemon, "spot1", "ros1")
    advices = (Advice.GO, Advice.DROP_NOW, Advice.DROP_NOW, Advice.GO, Advice.DROP_NOW)
    assert [drop.step(advice, answers=True) for advice in advices] == [""] * 5
    assert daemon.sent == [(TOPIC, "spot1")] * 2


def test_a_message_that_was_not_sent_is_sent_with_the_next_reading() -> None:
    daemon = Daemon(TOPIC)
    drop = BeaconDrop(daemon, "spot1", "ros1")
    assert drop.step(Advice.DROP_NOW, answers=False) == "no message to drop a beacon was sent"
    daemon.error = DaemonError("queue full", "queue-full")
    assert "queue full (sent again with the next reading)" in drop.step(Advice.DROP_NOW, answers=True)
    daemon.error = None
    assert drop.step(Advice.DROP_NOW, answers=True) == ""
    assert daemon.sent == [(TOPIC, "spot1")]


def test_a_message_that_may_have_been_sent_is_not_sent_again() -> None:
    daemon = Daemon(TOPIC)
    drop = BeaconDrop(daemon, "spot1", "ros1")
    daemon.error = DaemonError("the daemon closed the connection")
    assert "it may have been sent; not sent again" in drop.step(Advice.DROP_NOW, answers=True)
    daemon.error = None
    assert drop.step(Advice.DROP_NOW, answers=True) == ""
    assert daemon.sent == []
