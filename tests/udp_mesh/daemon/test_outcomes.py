"""A publisher hears of every outcome, however long it takes and whatever else it publishes."""

from __future__ import annotations

from typing import cast

import pytest

from udp_mesh.daemon import outcomes
from udp_mesh.daemon.api import Client, LocalServer
from udp_mesh.daemon.outcomes import AwaitedOutcomes, Publisher


@pytest.fixture
def publisher(monkeypatch: pytest.MonkeyPatch) -> Publisher:
    monkeypatch.setattr(outcomes, "MAX_MESSAGES_TO_SEVERAL", 3)
    return Publisher(Client(cast(LocalServer, FewBytes())), 7)


class FewBytes:
    def max_payload_bytes(self) -> int:
        return 1000


def test_a_message_to_a_peer_that_is_away_is_remembered_whatever_is_published_meanwhile(publisher: Publisher) -> None:
    waiting = AwaitedOutcomes()
    waiting.add(0, publisher, destination="base")
    for message in range(1, 100):
        waiting.add(message, publisher, destination="spot")
        assert waiting.publisher(message) is publisher
    assert waiting.publisher(0) is publisher
    assert waiting.publisher(0) is None


def test_a_message_to_several_peers_has_several_outcomes_until_enough_others_follow(publisher: Publisher) -> None:
    waiting = AwaitedOutcomes()
    for message in range(4):
        waiting.add(message, publisher, destination=None)
    assert [waiting.publisher(message) for message in (0, 3, 3, 3)] == [None, publisher, publisher, publisher]


def test_a_client_that_has_gone_is_forgotten(publisher: Publisher) -> None:
    waiting = AwaitedOutcomes()
    waiting.add(0, publisher, destination="base")
    waiting.add(1, publisher, destination=None)
    waiting.remove_client(publisher.client)
    assert [waiting.publisher(message) for message in (0, 1)] == [None, None]
