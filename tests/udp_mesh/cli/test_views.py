"""The daemon's replies as people read them."""

from dataclasses import replace

import pytest

from tests.udp_mesh.core.pair import pair
from udp_mesh.cli.views import peers_view
from udp_mesh.daemon.status import peer_json


@pytest.mark.parametrize(
    ("online", "one_way", "unanswered_for_s", "word"),
    [
        (True, False, None, "online"),
        (True, False, 1.0, "online"),
        (True, False, 14.0, "NO ANSWER"),
        (True, True, 14.0, "ONE WAY"),
        (False, False, 14.0, "OFFLINE"),
    ],
)
def test_a_peer_s_state_is_one_word(online: bool, one_way: bool, unanswered_for_s: float | None, word: str) -> None:
    both = pair()
    (found,) = both.a.conditions(both.now).peers
    peer = replace(found, online=online, one_way=one_way, unanswered_for_s=unanswered_for_s)
    line = peers_view([peer_json(peer, both.now)]).splitlines()[-1]
    assert f" {word} " in line
    assert ("14" in line) == (word == "NO ANSWER")
