"""Orders: signed by an operator for one plan at one site, and refused in every other case."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path

import pytest

from meshctl.device.connection import Credentials, fingerprint_of
from meshctl.device.trust import HostKey
from meshctl.sites.order import Order, OrderRefused, SignedOrder, checked_order, operator_keys, sign_order
from tests.meshctl.device.servers import keypair, public

_ORDER = Order("mines", "north", "0123456789abcdef", "provision", "alice@laptop", "a" * 64, "b" * 64, 12.5)


def _signed(directory: Path, kind: str = "ed25519") -> tuple[SignedOrder, tuple[HostKey, ...]]:
    key = keypair(directory / f"operator-{kind}", kind)
    keys = operator_keys(public(key).read_text())
    accepted = [fingerprint_of(each.blob) for each in keys]
    return sign_order(_ORDER, Credentials(key_files=(key,), use_agent=False), accepted), keys


@pytest.mark.parametrize("kind", ["ed25519", "rsa", "ecdsa"])
def test_an_operators_order_is_accepted(tmp_path: Path, kind: str) -> None:
    signed, keys = _signed(tmp_path, kind)
    assert checked_order(signed, keys, fleet="mines", site="north") == _ORDER


def test_an_order_of_a_key_that_no_operator_has_is_refused(tmp_path: Path) -> None:
    signed, _ = _signed(tmp_path)
    _, others = _signed(tmp_path, "ecdsa")
    with pytest.raises(OrderRefused, match="which is no operator's key at north"):
        checked_order(signed, others, fleet="mines", site="north")
    with pytest.raises(OrderRefused, match="no operator's key"):
        checked_order(signed, (), fleet="mines", site="north")


def test_an_order_that_was_changed_is_refused(tmp_path: Path) -> None:
    signed, keys = _signed(tmp_path)
    other = json.dumps(asdict(replace(_ORDER, plan_sha256="c" * 64)), sort_keys=True)
    with pytest.raises(OrderRefused, match="signature is wrong"):
        checked_order(replace(signed, text=other), keys, fleet="mines", site="north")


@pytest.mark.parametrize("signature", ["", "AAAA", "not base64", "AAAAC3NzaC1lZDI1NTE5AAAA"])
def test_a_damaged_signature_is_refused(tmp_path: Path, signature: str) -> None:
    signed, keys = _signed(tmp_path)
    with pytest.raises(OrderRefused):
        checked_order(replace(signed, signature=signature), keys, fleet="mines", site="north")


def test_an_order_for_another_site_or_fleet_is_refused(tmp_path: Path) -> None:
    signed, keys = _signed(tmp_path)
    with pytest.raises(OrderRefused, match="for mines/north, this is mines/south"):
        checked_order(signed, keys, fleet="mines", site="south")
    with pytest.raises(OrderRefused, match="this is caves/north"):
        checked_order(signed, keys, fleet="caves", site="north")


def test_without_an_accepted_key_the_error_says_what_to_do(tmp_path: Path) -> None:
    key = keypair(tmp_path / "operator")
    with pytest.raises(Exception, match="none of those keys is here"):
        sign_order(_ORDER, Credentials(key_files=(key,), use_agent=False), ["SHA256:other"])


def test_lines_that_are_no_keys_are_left_out() -> None:
    assert operator_keys("# operators\n\nssh-ed25519 broken alice\n") == ()
