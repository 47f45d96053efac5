"""A node that the inventory has moved, to another mesh or address, is reached where it was last seen."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from meshctl.device.errors import HostKeyUnknown
from meshctl.device.trust import AcceptAnyKey, TrustStore
from meshctl.errors import Unreachable
from meshctl.fleet.journal import LastKnown
from meshctl.inventory import load_fleet
from meshctl.nodes import connections
from meshctl.nodes.collect import former_addresses
from meshctl.nodes.connections import ConnectionPool

ROOT = Path(__file__).resolve().parents[3]
FLEET = load_fleet(ROOT / "inventory/lab")
Answer = Callable[[str], None]


def known(**addresses: str) -> dict[str, LastKnown]:
    return {name: LastKnown(name, 0.0, {"address": text} if text else {}) for name, text in addresses.items()}


def pool(tmp_path: Path) -> ConnectionPool:
    made = ConnectionPool(FLEET, TrustStore(tmp_path / "known_hosts"), use_agent=False)
    made.former_addresses = lambda: former_addresses(FLEET, known(b01="10.43.0.7"))
    return made


@pytest.fixture
def tried(monkeypatch: pytest.MonkeyPatch) -> tuple[list[str], dict[str, Exception]]:
    """The addresses that connections were opened to, and what those raise that do not answer."""
    addresses: list[str] = []
    errors: dict[str, Exception] = {"10.42.0.101": Unreachable("timed out")}

    def connect(endpoint: Any, **_options: Any) -> Any:
        addresses.append(endpoint.address)
        if endpoint.address in errors:
            raise errors[endpoint.address]
        return SimpleNamespace(endpoint=endpoint)

    monkeypatch.setattr(connections, "connect", connect)
    return addresses, errors


def test_only_addresses_that_the_inventory_has_changed_and_gives_to_no_other_count() -> None:
    seen = known(b01="10.43.0.7", b02="10.42.0.102", b03="10.42.0.101", base="", gone="10.43.0.9", rover1="nonsense")
    assert {name: str(one) for name, one in former_addresses(FLEET, seen).items()} == {"b01": "10.43.0.7"}


def test_a_node_that_does_not_answer_is_tried_where_it_was_last_seen(
    tmp_path: Path, tried: tuple[list[str], dict[str, Exception]]
) -> None:
    assert pool(tmp_path).open(FLEET.nodes["b01"]).endpoint.address == "10.43.0.7"
    assert tried[0] == ["10.42.0.101", "10.43.0.7"]


def test_another_device_at_the_former_address_is_not_taken_for_the_node(
    tmp_path: Path, tried: tuple[list[str], dict[str, Exception]]
) -> None:
    tried[1]["10.43.0.7"] = HostKeyUnknown("another", fingerprint="SHA256:x", key_type="ssh-ed25519")
    with pytest.raises(Unreachable, match="timed out"):
        pool(tmp_path).open(FLEET.nodes["b01"])
    assert tried[0] == ["10.42.0.101", "10.43.0.7"]


def test_a_connection_that_proves_an_address_or_pins_a_key_uses_no_other_address(
    tmp_path: Path, tried: tuple[list[str], dict[str, Exception]]
) -> None:
    opened, node = pool(tmp_path), FLEET.nodes["b01"]
    with pytest.raises(Unreachable):
        opened.open(node, endpoint=opened.endpoint(node))
    with pytest.raises(Unreachable):
        opened.open(node, policy=AcceptAnyKey())
    assert tried[0] == ["10.42.0.101"] * 2
