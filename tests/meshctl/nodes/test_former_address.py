"""A node that the inventory has moved, to another mesh, address or SSH port, is reached where it was last seen."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from meshctl.device.errors import AuthenticationRefused, HostKeyUnknown
from meshctl.device.observation import Observation
from meshctl.device.trust import AcceptAnyKey, TrustStore
from meshctl.errors import Unreachable
from meshctl.fleet.journal import LastKnown
from meshctl.inventory import load_fleet
from meshctl.model import Fleet
from meshctl.nodes import connections
from meshctl.nodes.collect import facts_of, former_places
from meshctl.nodes.connections import ConnectionPool

ROOT = Path(__file__).resolve().parents[3]
FLEET = load_fleet(ROOT / "inventory/lab")
Answer = Callable[[str], None]


def known(**addresses: str) -> dict[str, LastKnown]:
    return {name: LastKnown(name, 0.0, {"address": text} if text else {}) for name, text in addresses.items()}


def pool(tmp_path: Path) -> ConnectionPool:
    made = ConnectionPool(FLEET, TrustStore(tmp_path / "known_hosts"), use_agent=False)
    made.former_places = lambda: former_places(FLEET, known(b01="10.43.0.7"))
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
    assert {name: str(one.address) for name, one in former_places(FLEET, seen).items()} == {"b01": "10.43.0.7"}


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


@pytest.mark.parametrize(
    "error", [AuthenticationRefused("b01 (10.43.0.7): login refused"), Unreachable("b01 (10.43.0.7): timed out")]
)
def test_what_is_met_where_a_node_was_last_seen_is_reported_too(
    tmp_path: Path, tried: tuple[list[str], dict[str, Exception]], error: Exception
) -> None:
    tried[1]["10.43.0.7"] = error
    with pytest.raises(Unreachable) as caught:
        pool(tmp_path).open(FLEET.nodes["b01"])
    assert str(caught.value) == f"timed out; where it was last seen, {error}"


def test_a_connection_that_proves_an_address_or_pins_a_key_uses_no_other_address(
    tmp_path: Path, tried: tuple[list[str], dict[str, Exception]]
) -> None:
    opened, node = pool(tmp_path), FLEET.nodes["b01"]
    with pytest.raises(Unreachable):
        opened.open(node, endpoint=opened.endpoint(node))
    with pytest.raises(Unreachable):
        opened.open(node, policy=AcceptAnyKey())
    assert tried[0] == ["10.42.0.101"] * 2


def on_port(fleet: Fleet, name: str, port: int, **ssh: Any) -> Fleet:
    """The fleet with another `ssh.port` of a node."""
    node = fleet.nodes[name]
    return replace(fleet, nodes={**fleet.nodes, name: replace(node, ssh=replace(node.ssh, port=port, **ssh))})


@pytest.mark.parametrize("seen", [{"address": "10.42.0.101"}, {"address": "10.42.0.101", "port": "22"}])
def test_a_node_whose_ssh_port_the_inventory_has_changed_is_reached_at_its_former_port(
    tmp_path: Path, tried: tuple[list[str], dict[str, Exception]], seen: dict[str, str]
) -> None:
    """Before, it was unreachable, so nothing could give it the new port."""
    fleet = on_port(FLEET, "b01", 2222)
    tried[1]["[10.42.0.101]:2222"] = Unreachable("connection refused")
    del tried[1]["10.42.0.101"]
    opened = ConnectionPool(fleet, TrustStore(tmp_path / "known_hosts"), use_agent=False)
    opened.former_places = lambda: former_places(fleet, {"b01": LastKnown("b01", 0.0, seen)})
    assert opened.open(fleet.nodes["b01"]).endpoint.port == 22
    assert tried[0] == ["[10.42.0.101]:2222", "10.42.0.101"]


def test_the_port_of_a_host_in_front_of_a_node_is_not_the_port_of_the_node(
    tmp_path: Path, tried: tuple[list[str], dict[str, Exception]]
) -> None:
    fleet = on_port(FLEET, "b01", 2222, host="gateway")
    tried[1]["[gateway]:2222"] = Unreachable("connection refused")
    opened = ConnectionPool(fleet, TrustStore(tmp_path / "known_hosts"), use_agent=False)
    opened.former_places = lambda: former_places(fleet, {"b01": LastKnown("b01", 0.0, {"address": "10.42.0.101"})})
    with pytest.raises(Unreachable):
        opened.open(fleet.nodes["b01"])
    assert tried[0] == ["[gateway]:2222"]


def test_the_journal_knows_the_port_of_the_first_server_that_is_enabled() -> None:
    configured = "config dropbear\n\toption enable '0'\n\toption Port '23'\nconfig dropbear\n\toption Port '2222'\n"
    assert facts_of(Observation(0.0, 0.0, uci={"dropbear": configured}))["port"] == "2222"
    assert facts_of(Observation(0.0, 0.0, uci={"dropbear": "config dropbear\n"}))["port"] == "22"
    assert "port" not in facts_of(Observation(0.0, 0.0, uci={}))
