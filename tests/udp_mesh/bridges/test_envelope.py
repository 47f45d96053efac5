"""Zenoh samples as bytes, and the tokens of the ROS 2 graph."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from udp_mesh.bridges.envelope import Envelope, EnvelopeError, open_envelope, seal
from udp_mesh.bridges.rmw_zenoh import AnnouncementError, TokenExchange, carried_key, publisher_tokens, topic_keys

SAMPLES = st.builds(
    Envelope,
    st.text(st.characters(exclude_characters="*$?#", exclude_categories=["C"]), min_size=1, max_size=30),
    st.binary(max_size=50),
    st.text(st.characters(exclude_categories=["C"]), max_size=20),
    st.none() | st.binary(max_size=40),
    st.integers(1, 7),
    st.booleans(),
    st.booleans(),
    st.booleans(),
)
TOKEN = "@ros2_lv/0/ab/0/10/MP/%/%/talker/%chatter/std_msgs::msg::dds_::String_/RIHS01_df/1:2:1,10:,:,:,,"


@given(SAMPLES)
def test_a_sample_is_opened_as_it_was_sealed(sample: Envelope) -> None:
    assert open_envelope(seal(sample)) == sample


@given(st.binary(max_size=100) | SAMPLES.map(seal), st.integers(0, 100))
def test_any_bytes_are_a_sample_or_an_error(data: bytes, cut: int) -> None:
    data = data[:cut]
    try:
        sample = open_envelope(data)
    except EnvelopeError:
        return
    assert seal(sample) == data


def test_an_expression_is_no_key() -> None:
    with pytest.raises(EnvelopeError, match="one key"):
        open_envelope(seal(Envelope("demo/**", b"", "", None, 5, False, False, False)))


def test_keys_and_tokens_are_those_of_rmw_zenoh() -> None:
    assert topic_keys("/ns/chatter", 7) == "7/ns/chatter/*/*"
    assert publisher_tokens("/ns/chatter", 7) == "@ros2_lv/7/*/*/*/MP/*/*/*/%ns%chatter/*/*/*"


def test_a_token_is_set_up_once_and_withdrawn_with_its_last_announcer() -> None:
    alice, carol, bob = TokenExchange(), TokenExchange(), TokenExchange()
    alice.seen(TOKEN, True)
    carol.seen(TOKEN, True)
    assert bob.heard("alice", alice.announcement())[0] == ([TOKEN], [])
    assert bob.heard("carol", carol.announcement())[0] == ([], [])
    assert bob.gone("alice") == ([], [])
    carol.seen(TOKEN, False)
    assert bob.heard("carol", carol.announcement())[0] == ([], [TOKEN])


def test_what_a_bridge_set_up_is_announced_by_none() -> None:
    alice, bob, twin = TokenExchange(), TokenExchange(), TokenExchange()
    alice.seen(TOKEN, True)
    change, _ = bob.heard("alice", alice.announcement())
    for token in change.declare:
        for exchange in (bob, twin):
            exchange.carried(carried_key("session", token), True)
            exchange.seen(token, True)
    assert TOKEN.encode() not in bob.announcement()
    assert TOKEN.encode() not in twin.announcement()


@given(st.binary(max_size=100))
def test_any_bytes_are_an_announcement_or_an_error(data: bytes) -> None:
    exchange = TokenExchange()
    try:
        exchange.heard("alice", data)
    except AnnouncementError:
        assert exchange.gone("alice") == ([], [])


def test_an_announcement_sets_up_nothing_but_publishers_tokens() -> None:
    for token in ("demo/x", "@ros2_lv/**", "@ros2_lv//x", "@ros2_lv/x/", "@ros2_lv/" + "x" * 2000):
        with pytest.raises(AnnouncementError):
            TokenExchange().heard("alice", b'{"tokens": ["' + token.encode() + b'"]}')
