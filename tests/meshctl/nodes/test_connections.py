"""Pooled connections are closed in parallel, and jump connections after them."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest

from meshctl.device.connection import Endpoint
from meshctl.device.errors import HANDSHAKE, Timeout
from meshctl.device.ssh import SshConnection
from meshctl.device.trust import TrustStore
from meshctl.errors import Unreachable
from meshctl.inventory import load_fleet
from meshctl.nodes import connections
from meshctl.nodes.collect import collect
from meshctl.nodes.connections import ConnectionPool

ROOT = Path(__file__).resolve().parents[3]
PATIENCE_S = 60.0


class Kept(SshConnection):
    """One whose closing waits until others close, too."""

    def __init__(self, name: str, others: threading.Barrier, closed: list[str]) -> None:
        self._name = name
        self._others = others
        self._closed = closed

    @property
    def is_open(self) -> bool:
        return self._name not in self._closed

    def close(self) -> None:
        self._others.wait(PATIENCE_S)
        self._closed.append(self._name)


def test_pooled_connections_close_in_parallel_before_their_jump_hosts(tmp_path: Path) -> None:
    closed: list[str] = []
    access = ConnectionPool(load_fleet(ROOT / "inventory/lab"), TrustStore(tmp_path / "known_hosts"))
    together = threading.Barrier(8)
    for number in range(8):
        access.release(f"b{number}", Kept(f"b{number}", together, closed))
    access._jumps["base"] = Kept("base", threading.Barrier(1), closed)
    access.close()
    assert closed[-1] == "base"
    assert sorted(closed[:-1]) == [f"b{number}" for number in range(8)]
    assert access.acquire("b0") is None
    access.close()
    assert len(closed) == 9


def test_a_router_is_also_tried_at_its_address_in_the_robots_lan(tmp_path: Path) -> None:
    fleet = load_fleet(ROOT / "inventory/routed")
    access = ConnectionPool(fleet, TrustStore(tmp_path / "known_hosts"))
    tried = [end.address for end in access.candidates(fleet.nodes["rover1-radio"])]
    # over a wire to its LAN port, only the second one answers
    assert tried == ["10.42.0.11", "10.43.1.1"]
    assert [end.address for end in access.candidates(fleet.nodes["b01"])] == ["10.42.0.101"]
    access.interfaces["rover1-radio"] = "eth1"
    ends = [(end.address, end.interface) for end in access.candidates(fleet.nodes["rover1-radio"])]
    assert ends == [("10.42.0.11", "eth1"), ("10.43.1.1", "eth1"), ("10.42.0.11", ""), ("10.43.1.1", "")]


@pytest.mark.parametrize(("phase", "is_silent"), [(HANDSHAKE, True), ("connect", False)])
def test_a_server_that_accepts_and_stays_silent_is_distinguished_from_a_node_that_does_not_answer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, phase: str, is_silent: bool
) -> None:
    """Also if the node has another address, at which nothing answers."""

    def refuse(endpoint: Endpoint, **_: object) -> SshConnection:
        if endpoint.address == "10.42.0.11":
            raise Timeout("silent", phase=phase)
        raise Unreachable("no route")

    monkeypatch.setattr(connections, "connect", refuse)
    fleet = load_fleet(ROOT / "inventory/routed")
    pool = ConnectionPool(fleet, TrustStore(tmp_path / "known_hosts"))
    observed = collect(pool, [fleet.nodes["rover1-radio"]], parallel=1)
    assert observed.unreachable == {"rover1-radio": "silent" if is_silent else "no route"}
    assert observed.silent_servers == ({"rover1-radio"} if is_silent else set())
