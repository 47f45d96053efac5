"""Zenoh samples as bytes, and the tokens of the ROS 2 graph."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from udp_mesh.bridges.envelope import Envelope, EnvelopeError, open_envelope, seal
from udp_mesh.bridges.rmw_zenoh import (
    AnnouncementError,
    SampleDeduplicator,
    TokenExchange,
    carried_key,
    kept_samples,
    publisher_tokens,
    topic_keys,
)

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
    st.booleans(),
)
TOKEN = "@ros2_lv/0/ab/0/10/MP/%/%/talker/%chatter/std_msgs::msg::dds_::String_/RIHS01_df/1:2:1,10:,:,:,,"


@given(SAMPLES)
def test_an_envelope_round_trips_through_seal_and_open(sample: Envelope) -> None:
    assert open_envelope(seal(sample)) == sample


@given(st.binary(max_size=100) | SAMPLES.map(seal), st.integers(0, 100))
def test_any_bytes_decode_to_a_sample_or_raise_an_error(data: bytes, cut: int) -> None:
    data = data[:cut]
    try:
        sample = open_envelope(data)
    except EnvelopeError:
        return
    assert seal(sample) == data


def test_a_key_expression_is_not_accepted_as_a_key() -> None:
    with pytest.raises(EnvelopeError, match="one key"):
        open_envelope(seal(Envelope("demo/**", b"", "", None, 5, False, False, False)))


def test_topic_keys_and_tokens_match_rmw_zenoh() -> None:
    assert topic_keys("/ns/chatter", 7) == "7/ns/chatter/*/*"
    assert publisher_tokens("/ns/chatter", 7) == "@ros2_lv/7/*/*/*/MP/*/*/*/%ns%chatter/*/*/*"


@pytest.mark.parametrize(
    ("quality", "depth"),
    [
        (":1:,1:,:,:,,", 1),
        ("1:1:1,5:,:,:,,", 5),
        (":1:,:,:,:,,", 42),
        (":1:2,:,:,:,,", 1000),
        (":1:,99999:,:,:,,", 1000),
        ("::,10:,:,:,,", 0),
        ("1:2:1,10:,:,:,,", 0),
        ("nonsense", 0),
    ],
)
def test_token_qos_determines_how_many_samples_are_kept(quality: str, depth: int) -> None:
    token = f"@ros2_lv/7/ab/0/10/MP/%/%ns/talker/%ns%chatter/a::B_/RIHS01_df/{quality}"
    assert kept_samples(token) == ("7/ns/chatter/a::B_/RIHS01_df", depth)


def test_only_transient_local_publisher_tokens_keep_samples() -> None:
    assert kept_samples("@ros2_lv/0/ab/0/0/NN/%/%/talker") == ("", 0)
    assert kept_samples(TOKEN.replace("/MP/", "/MS/").replace("1:2:", ":1:"))[1] == 0


def test_a_duplicate_sample_is_new_only_once() -> None:
    kept = SampleDeduplicator()
    assert [kept.is_new("k", b"a", b"p") for _ in range(2)] == [True, False]
    assert kept.is_new("k", b"", b"ap")
    assert kept.is_new("ka", None, b"p")


def test_a_token_is_declared_once_and_withdrawn_with_its_last_announcer() -> None:
    alice, carol, bob = TokenExchange(), TokenExchange(), TokenExchange()
    alice.on_token(TOKEN, True)
    carol.on_token(TOKEN, True)
    assert bob.on_announcement("alice", alice.announcement())[0] == ([TOKEN], [])
    assert bob.on_announcement("carol", carol.announcement())[0] == ([], [])
    assert bob.on_robot_gone("alice") == ([], [])
    carol.on_token(TOKEN, False)
    assert bob.on_announcement("carol", carol.announcement())[0] == ([], [TOKEN])


def test_tokens_declared_by_a_bridge_are_not_announced_again() -> None:
    alice, bob, twin = TokenExchange(), TokenExchange(), TokenExchange()
    alice.on_token(TOKEN, True)
    change, _ = bob.on_announcement("alice", alice.announcement())
    for token in change.declare:
        for exchange in (bob, twin):
            exchange.on_companion(carried_key("session", token), True)
            exchange.on_token(token, True)
    assert TOKEN.encode() not in bob.announcement()
    assert TOKEN.encode() not in twin.announcement()


@given(st.binary(max_size=100))
def test_any_bytes_decode_to_an_announcement_or_raise_an_error(data: bytes) -> None:
    exchange = TokenExchange()
    try:
        exchange.on_announcement("alice", data)
    except AnnouncementError:
        assert exchange.on_robot_gone("alice") == ([], [])


def test_an_announcement_with_an_invalid_token_is_rejected() -> None:
    for token in ("demo/x", "@ros2_lv/**", "@ros2_lv//x", "@ros2_lv/x/", "@ros2_lv/" + "x" * 2000):
        with pytest.raises(AnnouncementError):
            TokenExchange().on_announcement("alice", b'{"tokens": ["' + token.encode() + b'"]}')
