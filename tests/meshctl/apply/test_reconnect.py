"""Reconnecting unreachable nodes takes minutes, shows what it does, and ends with the first interrupt."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from ipaddress import ip_address
from types import SimpleNamespace
from typing import Any, cast

import pytest

from meshctl.apply import reconnect as reconnecting
from meshctl.apply.reconnect import (
    Reconnected,
    entries_of_unreachable,
    last_relays,
    open_repaired,
    reconnect,
    repaired,
)
from meshctl.apply.stale_stations import StationEntry
from meshctl.device.errors import HANDSHAKE, ConnectionLost, Timeout
from meshctl.device.observation import Station
from meshctl.fleet import Event, EventKind, Interrupt
from meshctl.fleet.journal import LastKnown
from meshctl.model import Node
from meshctl.nodes.collect import FleetObservation
from meshctl.nodes.connections import ConnectionPool, SshAddress
from tests.meshctl.apply.mesh_nodes import MAC, MACS, OTHER, node
from tests.meshctl.plan.support import fleet, running


class SilentNeighbor:
    """A connection whose script runs until the connection is closed."""

    def __init__(self) -> None:
        self.closed = threading.Event()

    def run(self, script: str, *, timeout_s: float) -> Any:
        assert self.closed.wait(60), "the connection is closed by the interrupt"
        raise ConnectionLost("b01: closed")

    def close(self) -> None:
        self.closed.set()


@pytest.mark.parametrize("when", ["before it is connected", "while it is asked"])
def test_an_interrupt_need_not_wait_for_neighbors_that_repair_their_links(when: str) -> None:
    interrupt, events, neighbor = Interrupt(), list[Event](), SilentNeighbor()

    @contextmanager
    def borrow(_node: object) -> Iterator[SilentNeighbor]:
        if when == "before it is connected":
            interrupt.request()
        yield neighbor

    def observer(event: Event) -> None:
        events.append(event)

    def run(script: str, *, timeout_s: float) -> Any:
        interrupt.request()
        return SilentNeighbor.run(neighbor, script, timeout_s=timeout_s)

    if when == "while it is asked":
        neighbor.run = run  # type: ignore[method-assign]
    heard = Station("mesh0", MAC, inactive_ms=200, connected_s=500)
    around = {"b01": replace(running(fleet(), "b01", neighbors=()), stations=(heard,))}
    seen = FleetObservation(around, {"b02": "no answer"})
    pool = cast(ConnectionPool, SimpleNamespace(borrow=borrow, former_places=dict))
    reconnect(pool, fleet(), seen, {MAC: "b02"}, interrupt=interrupt, observer=observer)
    assert [(event.kind, event.node) for event in events] == [(EventKind.STEP, "b01"), (EventKind.FINISHED, "b01")]
    assert events[0].text.startswith("repairs its links to nodes that do not answer (at most ")


@pytest.mark.parametrize("former", [None, "10.42.0.99", "its own"])
def test_a_node_that_does_not_answer_has_its_ssh_server_tried_by_its_neighbors(former: str | None) -> None:
    """It may answer their echo requests, which are of another traffic class (finding 25 of node-assumptions.md). If the
    inventory gives it another address or port, it still listens where it was last seen."""
    scripts: list[str] = []
    b02 = fleet().nodes["b02"]
    own = SshAddress(b02.address.ip, b02.ssh.port)
    places = {} if former is None else {"b02": own if former == "its own" else SshAddress(ip_address(former), 2222)}

    def run(script: str, *, timeout_s: float) -> Any:
        scripts.append(script)
        return SimpleNamespace(stdout=f"gone {MAC}\n")

    @contextmanager
    def borrow(_node: object) -> Iterator[object]:
        yield SimpleNamespace(run=run)

    heard = Station("mesh0", MAC, inactive_ms=200, connected_s=500)
    around = {"b01": replace(running(fleet(), "b01", neighbors=()), stations=(heard,))}
    pool = cast(ConnectionPool, SimpleNamespace(borrow=borrow, former_places=lambda: places))
    seen = FleetObservation(around, {"b02": "no answer"})
    assert reconnect(pool, fleet(), seen, {MAC: "b02"}, interrupt=Interrupt()).nodes == {"b02"}
    (script,) = scripts
    calls = [line for line in script.splitlines() if line.startswith("flush_stale mesh0 ")]
    elsewhere = [f"flush_stale mesh0 {MAC} 0 {former} 2222"] if former == "10.42.0.99" else []
    assert calls == [f"flush_stale mesh0 {MAC} 0 {b02.address.ip} {b02.ssh.port}", *elsewhere]


class Behind:
    """b02, which does not answer until b01, which hears it, has removed a stale entry, if that helps."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *, helps: bool, is_silent: bool = False) -> None:
        self.asked: list[str] = []
        self.tries = 0
        self.helps, self.is_silent = helps, is_silent
        heard = Station("mesh0", MAC, inactive_ms=200, connected_s=500)
        around = {"b01": replace(running(fleet(), "b01", neighbors=()), stations=(heard,))}
        monkeypatch.setattr(reconnecting, "collect", lambda *_, **__: FleetObservation(around, {}))
        monkeypatch.setattr(reconnecting, "RELEARN_S", 0.0)
        self.pool = cast(ConnectionPool, SimpleNamespace(open=self.open, borrow=self.borrow, former_places=dict))

    def open(self, there: Node) -> Any:
        self.tries += 1
        if not self.asked or not self.helps:
            raise Timeout("b02: no answer", phase=HANDSHAKE if self.is_silent else "connect")
        return there.name

    @contextmanager
    def borrow(self, there: Node) -> Iterator[Any]:
        def run(script: str, *, timeout_s: float) -> Any:
            self.asked.append(there.name)
            return SimpleNamespace(stdout=f"gone {MAC}\n")

        yield SimpleNamespace(run=run)


KNOWN = {"b02": LastKnown("b02", 1.0, {"macs": MAC})}


def test_a_node_to_be_restored_is_reached_once_its_neighbors_have_repaired_their_links(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """`meshctl restore` gave up at the first attempt, although `provision` reaches such a node."""
    behind, events = Behind(monkeypatch, helps=True), list[Event]()
    b02 = fleet().nodes["b02"]
    opened, notes = open_repaired(behind.pool, fleet(), b02, KNOWN, interrupt=Interrupt(), observer=events.append)
    assert (str(opened), behind.asked, behind.tries) == ("b02", ["b01"], 2)
    assert notes == ("b02: b01 removed a stale entry of its radio",)
    assert [(event.kind, event.node) for event in events] == [(EventKind.STEP, "b02")]


def test_a_node_that_stays_unreachable_is_tried_once_more_only_after_a_repair(monkeypatch: pytest.MonkeyPatch) -> None:
    b02 = fleet().nodes["b02"]
    behind = Behind(monkeypatch, helps=False)
    with pytest.raises(Timeout):
        open_repaired(behind.pool, fleet(), b02, KNOWN, interrupt=Interrupt())
    assert behind.tries == 2
    interrupt = Interrupt()
    interrupt.request()
    stopped = Behind(monkeypatch, helps=True)
    with pytest.raises(Timeout):
        open_repaired(stopped.pool, fleet(), b02, KNOWN, interrupt=interrupt)
    assert (stopped.tries, stopped.asked) == (1, [])


def test_no_link_is_repaired_to_a_node_whose_server_accepts_connections_and_stays_silent(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    behind = Behind(monkeypatch, helps=True, is_silent=True)
    with pytest.raises(Timeout):
        open_repaired(behind.pool, fleet(), fleet().nodes["b02"], KNOWN, interrupt=Interrupt())
    assert (behind.tries, behind.asked) == (1, [])


def test_only_neighbors_that_hear_an_unreachable_node_now_are_asked_for_stale_entries() -> None:
    heard = Station("mesh0", MAC, inactive_ms=200, connected_s=500)
    silent, reachable = replace(heard, inactive_ms=30_000), replace(heard, mac=MACS["b03"])
    around = {
        "b01": replace(node("b01"), stations=(heard, reachable)),
        "b03": replace(node("b03"), stations=(silent,)),
        "b04": replace(node("b04"), stations=(reachable,)),
    }
    owners = {mac: name for name, mac in MACS.items()}
    asked = entries_of_unreachable(FleetObservation(around, {"b02": "no answer"}), owners)
    assert {holder: [(one.ifname, one.mac) for one in entries] for holder, entries in asked.items()} == {
        "b01": [("mesh0", MAC)]
    }
    assert entries_of_unreachable(FleetObservation(around, {}), owners) == {}


def test_no_entry_of_a_node_is_touched_whose_server_accepts_connections_and_stays_silent() -> None:
    """A stale entry drops what accepts a connection, too; one that is removed by mistake cuts the node off."""
    heard = Station("mesh0", MAC, inactive_ms=200, connected_s=500)
    around = {"b01": replace(node("b01"), stations=(heard, replace(heard, mac=OTHER)))}
    owners = {mac: name for name, mac in MACS.items()}
    seen = FleetObservation(around, {"b02": "no answer to the SSH handshake"}, silent_servers=frozenset({"b02"}))
    assert entries_of_unreachable(seen, owners) == {}
    # nor is a radio of an unknown node taken for its own
    assert entries_of_unreachable(seen, {}) == {}


def test_an_unknown_radio_may_belong_to_a_node_without_a_known_mac() -> None:
    """A node that was never seen, and whose MAC the inventory does not have, such as at a site with a new journal."""
    heard = tuple(Station("mesh0", MACS[name], inactive_ms=30) for name in ("b02", "b03", "b04"))
    around = {"b01": replace(node("b01"), stations=heard), "b03": node("b03")}
    without = {MACS[name]: name for name in ("b01", "b04")}
    asked = entries_of_unreachable(FleetObservation(around, {"b02": "no answer"}), without)
    # b03 was observed, and b04 is known and reachable
    assert [(one.holder, one.mac) for one in asked["b01"]] == [("b01", MAC)]
    assert entries_of_unreachable(FleetObservation(around, {"b02": "no answer"}), {**without, OTHER: "b02"}) == {}


def test_what_was_repaired_is_reported_once_for_each_radio() -> None:
    owners = {MACS["b04"]: "b04"}
    entries = [StationEntry("", "mesh0", mac) for mac in (MAC, MACS["b04"])]
    asked = dict.fromkeys(("b01", "b03", "base"), entries)
    answers = {
        "b01": f"gone {MACS['b04'].upper()}\nanswers {MACS['b04']}\n",
        "b03": f"gone {MACS['b04']}\n",
        "base": "",
    }
    away = ("b02", "b04")
    assert repaired(answers, asked, away, owners) == Reconnected(
        frozenset({"b04"}), ("b04: b01, b03 removed a stale entry of its radio",)
    )
    unknown = repaired({"b01": f"silent {MAC}\ncaught-up {MAC}\n"}, asked, away, owners)
    assert unknown.nodes == {"b02"}
    assert unknown.notes[0].startswith(f"{MAC}, a radio of an unknown node: b01 sent echo requests until")
    assert repaired({"b01": "gone \x1b[2J\n"}, asked, away, owners) == Reconnected()
    assert repaired({"b01": f"kept {MAC}\nsilent {MAC}\n"}, asked, away, owners) == Reconnected()


def test_a_neighbor_that_loses_its_own_link_meanwhile_has_its_nodes_tried_again() -> None:
    asked = {"b01": [StationEntry("b01", "mesh0", MAC)]}
    assert repaired({"b01": None}, asked, ("b02",), {MAC: "b02"}) == Reconnected(
        frozenset({"b02"}), ("b02: b01 hears it, and did not answer when asked to repair the link",)
    )


def test_the_relays_to_an_unreachable_node_are_those_of_its_last_path() -> None:
    """It may be a relay that is not heard. A path that leads in a circle was recorded at two times."""
    known = {
        name: LastKnown(name, 0.0, {"via": via} if via else {})
        for name, via in {"b03": "b02", "b02": "b01", "b01": "base", "base": "", "b04": "b05", "b05": "b04"}.items()
    }
    assert list(last_relays(["b03"], known)) == ["b02", "b01", "base"]
    assert list(last_relays(["b04"], known)) == ["b05"]
    assert list(last_relays(["unknown"], known)) == []
