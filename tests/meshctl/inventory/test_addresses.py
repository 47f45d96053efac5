"""Address rules."""

from __future__ import annotations

from ipaddress import IPv4Address, IPv4Network

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic_core import PydanticCustomError

from meshctl.inventory.addresses import AddressRule, BadAddress, parse_address, parse_rule

_NETWORK = IPv4Network("10.42.0.0/16")


@given(st.integers(0, 9999), st.integers(0, 99), st.integers(1, 300))
def test_a_rule_computes_offset_plus_factor_times_index(offset: int, factor: int, index: int) -> None:
    rule = parse_rule(f"network + {offset} + {factor} * index")
    assert int(rule.address(_NETWORK, index)) - int(_NETWORK.network_address) == offset + factor * index
    assert rule == parse_rule(f"network+index*{factor}+{offset}")


def test_the_first_address_of_a_from_rule_is_the_given_one() -> None:
    rule = parse_address({"from": "10.42.0.101"})
    assert isinstance(rule, AddressRule)
    assert [str(rule.address(None, index)) for index in (1, 2, 3)] == ["10.42.0.101", "10.42.0.102", "10.42.0.103"]


def test_a_rule_can_start_at_an_address_and_subtract() -> None:
    assert parse_rule("10.42.1.0 + 2 * index - 1").address(None, 3) == IPv4Address("10.42.1.5")


@pytest.mark.parametrize(
    "text",
    [
        "",
        "index",
        "network index",
        "network + network",
        "2 * network",
        "network + x",
        "+ network",
        "network +",
        "1 + 2",
    ],
)
def test_an_invalid_address_rule_is_rejected(text: str) -> None:
    with pytest.raises(PydanticCustomError):
        parse_rule(text)


@given(st.text(alphabet="network index+-*0123456789.", max_size=30))
def test_arbitrary_text_parses_as_a_rule_or_is_rejected(text: str) -> None:
    try:
        rule = parse_rule(text)
    except PydanticCustomError:
        return
    try:
        rule.address(_NETWORK, 1)
    except BadAddress as reason:
        assert str(reason)


def test_a_network_rule_without_a_network_is_rejected() -> None:
    with pytest.raises(BadAddress):
        parse_rule("network + index").address(None, 1)
