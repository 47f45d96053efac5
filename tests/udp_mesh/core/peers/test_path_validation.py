"""What answers a challenge: a pong with its token, from the address and link that were challenged, in time."""

from __future__ import annotations

import pytest

from tests.udp_mesh.core.pair import KEY, settings
from udp_mesh.core.peers.path_validation import match_response
from udp_mesh.core.peers.session import CHALLENGE_TIMEOUT_S, Challenge, Session
from udp_mesh.core.settings import Address
from udp_mesh.wire.frames import Pong

HERE, ELSEWHERE = ("10.0.0.9", 8700), ("10.0.0.66", 8700)
TOKEN = 7


@pytest.mark.parametrize(
    ("link", "source", "token", "later_s", "answers"),
    [
        ("mesh", HERE, TOKEN, 0.1, True),
        ("mesh", ELSEWHERE, TOKEN, 0.1, False),
        ("mesh", (HERE[0], 9999), TOKEN, 0.1, False),
        ("other", HERE, TOKEN, 0.1, False),
        ("mesh", HERE, TOKEN + 1, 0.1, False),
        ("mesh", HERE, TOKEN, 2 * CHALLENGE_TIMEOUT_S, False),
    ],
)
def test_a_challenge_is_answered_from_where_it_was_sent(
    link: str, source: Address, token: int, later_s: float, *, answers: bool
) -> None:
    session = Session("b", bytes(range(16)), bytes(16), (KEY,), settings("b"))
    challenge = Challenge("mesh", HERE, 100.0, in_use=False)
    session.challenges[TOKEN] = challenge
    found = match_response(session, Pong(token, 0), link, source, 100.0 + later_s)
    assert found == (challenge if answers else None)
    if answers:
        assert match_response(session, Pong(token, 0), link, source, 100.0 + later_s) is None
