"""A publisher hears of every outcome, however long it takes and whatever else it publishes."""

from __future__ import annotations

from typing import cast

import pytest

from udp_mesh.daemon import outcomes
from udp_mesh.daemon.api import Client, LocalServer
from udp_mesh.daemon.outcomes import AwaitedOutcomes


@pytest.fixture
def client(monkeypatch: pytest.MonkeyPatch) -> Client:
    monkeypatch.setattr(outcomes, "MAX_MESSAGES_TO_SEVERAL", 3)
    return Client(cast(LocalServer, FewBytes()))


class FewBytes:
    def max_payload_bytes(self) -> int:
        return 1000


def test_a_message_to_a_peer_that_is_away_is_remembered_whatever_is_published_meanwhile(client: Client) -> None:
    waiting = AwaitedOutcomes()
    waiting.add(0, client, destination="base")
    for message in range(1, 100):
        waiting.add(message, client, destination="spot")
        assert waiting.publisher(message) is client
    assert waiting.publisher(0) is client
    assert waiting.publisher(0) is None


def test_a_message_to_several_peers_has_several_outcomes_until_enough_others_follow(client: Client) -> None:
    waiting = AwaitedOutcomes()
    for message in range(4):
        waiting.add(message, client, destination=None)
    assert [waiting.publisher(message) for message in (0, 3, 3, 3)] == [None, client, client, client]


def test_a_client_that_has_gone_is_forgotten(client: Client) -> None:
    waiting = AwaitedOutcomes()
    waiting.add(0, client, destination="base")
    waiting.add(1, client, destination=None)
    waiting.remove_client(client)
    assert [waiting.publisher(message) for message in (0, 1)] == [None, None]
