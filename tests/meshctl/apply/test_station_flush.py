"""Neighbors flush stale station entries after every kind of radio restart, and after nothing else."""

from __future__ import annotations

import re
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import pytest

from meshctl.apply import station_flush
from meshctl.apply.context import NodeContext, RunContext
from meshctl.apply.neighbor_query import REMEMBERED_S, known_neighbors
from meshctl.apply.station_flush import StationFlushes
from meshctl.device.observation import NetInterface, Observation, Originator
from meshctl.device.ssh import SshConnection
from meshctl.errors import NodeError
from meshctl.fleet.journal import LastKnown
from meshctl.plan.radios import EVERY_RADIO, NO_RADIOS, Radios
from tests.meshctl.apply.mesh_nodes import MAC, MACS, node
from tests.meshctl.plan.support import fleet


class Neighbors:
    """A fleet whose neighbors answer or do not: the queries, and the notes for the operator."""

    def __init__(self, around: dict[str, Observation], *, silent: tuple[str, ...] = (), answer: str = f"gone {MAC}\n"):
        self.flushes = StationFlushes()
        self.silent = set(silent)
        self.log_in: Callable[[], None] = lambda: None
        self.answer = answer
        self.asked: list[tuple[str, str]] = []
        self.notes: list[str] = []
        self.steps: list[str] = []
        self.work = cast(
            "RunContext",
            SimpleNamespace(
                fleet=fleet(),
                observations=around,
                current_mac_owners=lambda: {mac: name for name, mac in MACS.items()},
                current_base_macs=lambda _: frozenset(),
                interrupt=SimpleNamespace(leaving=False),
                connections=SimpleNamespace(
                    acquire=lambda name: None, open=self._open, release=lambda name, kept: None
                ),
                note=lambda text, name: self.notes.append(f"{name}: {text}"),
            ),
        )
        before = around.get("b02") or node("b02")
        job = SimpleNamespace(name="b02", node=fleet().nodes["b02"], run=self.work, step=self._step, before=before)
        self.job = cast("NodeContext", job)

    def _open(self, there: SimpleNamespace, **_: object) -> SimpleNamespace:
        if there.name in self.silent:
            raise NodeError("it does not answer")
        self.log_in()

        def run(script: str, *, timeout_s: float) -> SimpleNamespace:
            self.asked.append((there.name, script))
            return SimpleNamespace(stdout=self.answer)

        return SimpleNamespace(run=run, close=lambda: None)

    @contextmanager
    def _step(self, name: str) -> Iterator[None]:
        self.steps.append(name)
        yield

    @property
    def names(self) -> list[str]:
        return sorted(name for name, _ in self.asked)


def watching(scripts: list[str], exit_status: int = 0) -> SshConnection:
    """A connection to the node, on which it starts to watch or cannot."""

    def run(script: str) -> SimpleNamespace:
        scripts.append(script)
        return SimpleNamespace(exit_status=exit_status)

    return cast("SshConnection", SimpleNamespace(run=run))


def test_repeated_queries_are_journaled_and_reported_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    near = Neighbors({"b02": node("b02"), "b01": node("b01", "b02")})
    monkeypatch.setattr("meshctl.apply.station_flush.next_query_s", lambda asked_s: float("-inf"))
    flush = near.flushes.listener(near.job, EVERY_RADIO)
    flush.started()
    for _ in range(5):
        flush.unreachable()
    flush.ended()
    assert near.names == ["b01"] * 6
    assert near.steps == ["flush neighbor station entries"]
    assert near.notes == ["b02: b01 removed a stale entry of its radio"]


@pytest.mark.parametrize("radios", [NO_RADIOS, Radios(frozenset({"mesh1"}))])
def test_a_node_that_stays_unreachable_may_have_lost_its_power_whatever_its_change_restarts(
    monkeypatch: pytest.MonkeyPatch, radios: Radios
) -> None:
    """Seen on real OpenWrt: a second radio was to join, the power was cut, and the first radio's neighbor did not hear
    the node's unicast for minutes, so that it stayed unreachable although it was back in its mesh."""
    now_s = [1000.0]
    monkeypatch.setattr("meshctl.apply.station_flush.time", SimpleNamespace(monotonic=lambda: now_s[0]))
    near = Neighbors({"b02": node("b02"), "b01": node("b01", "b02")})
    flush = near.flushes.listener(near.job, radios)
    flush.started()
    now_s[0] += 15
    flush.observed()
    now_s[0] += 15
    flush.unreachable()
    assert near.asked == []
    now_s[0] += 10
    flush.unreachable()
    ((name, script),) = near.asked
    assert (name, script.splitlines()[-1]) == ("b01", f"flush_stale mesh0 {MAC} 40")
    assert near.notes == ["b02: b01 removed a stale entry of its radio"]


def test_neighbors_that_the_plan_did_not_observe_are_queried_for_a_node_that_may_have_lost_its_power(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Seen on real OpenWrt: a change of one node's host name, whose plan observed that node alone, and a power cut."""
    now_s = [1000.0]
    monkeypatch.setattr("meshctl.apply.station_flush.time", SimpleNamespace(monotonic=lambda: now_s[0]))
    near = Neighbors({"b02": node("b02", "b01")})
    flush = near.flushes.listener(near.job, NO_RADIOS)
    flush.started()
    now_s[0] += 15
    flush.unreachable()
    assert near.asked == []
    now_s[0] += 10
    flush.unreachable()
    ((name, script),) = near.asked
    assert name == "b01"
    assert "iw dev 2>/dev/null" in script.splitlines()[-1]
    assert script.endswith(f"{MAC} 25\n")


@pytest.mark.parametrize(
    ("had", "radios", "login"),
    [
        ("10.42.0.102", EVERY_RADIO, " 10.42.0.102 22"),
        # no radio restarts: only a boot explains a stale entry, and changes this MAC
        ("10.42.0.102", NO_RADIOS, " 10.42.0.102 22 76:9f:08:ba:c9:d5"),
        ("10.42.0.99", EVERY_RADIO, ""),
    ],
)
def test_a_node_that_is_unreachable_although_it_must_answer_logins_is_logged_in_to_by_its_neighbors(
    monkeypatch: pytest.MonkeyPatch, had: str, radios: Radios, login: str
) -> None:
    """Once, even if they were queried a moment ago; not if the change gives it another address: it has its old one."""
    now_s = [1000.0]
    monkeypatch.setattr("meshctl.apply.station_flush.time", SimpleNamespace(monotonic=lambda: now_s[0]))
    interfaces = (NetInterface("lan", up=True, pending=False, addresses=(f"{had}/24",)),)
    before = replace(node("b02"), interfaces=interfaces)
    before = replace(before, macs={**(before.macs or {}), "bat0": "76:9f:08:ba:c9:d5"})
    near = Neighbors({"b02": before, "b01": node("b01", "b02")})
    flush = near.flushes.listener(near.job, radios)
    flush.started()
    now_s[0] += 100
    flush.unreachable()
    for _ in range(2):
        flush.unreachable(is_login_due=True)
    lines = [script.splitlines()[-1] for _, script in near.asked]
    assert lines == [f"flush_stale mesh0 {MAC} 100{where}" for where in ("", login)][: 1 + (login != "")]
    # also where it is noticed that the node is silent before a connection has failed
    now_s[0] += 100
    flush.unreachable()
    assert near.asked[-1][1].endswith(f" {MAC} 200{login}\n")
    flush.started()
    now_s[0] += 100
    flush.unreachable()
    assert near.asked[-1][1].endswith(f" {MAC} 100\n")


@pytest.mark.parametrize(("exit_status", "login"), [(0, " 10.42.0.102 22"), (1, "")])
def test_neighbors_log_in_to_a_node_that_would_notice_if_they_removed_an_entry_by_mistake(
    exit_status: int, login: str
) -> None:
    """A change of the network may drop logins, and so may a stale entry that passes echo replies."""
    interfaces = (NetInterface("lan", up=True, pending=False, addresses=("10.42.0.102/24",)),)
    near = Neighbors({"b02": replace(node("b02", "b01"), interfaces=interfaces), "b01": node("b01", "b02")})
    flush = near.flushes.listener(near.job, EVERY_RADIO)
    flush.armed(watching([], exit_status), for_s=100.0)
    flush.started()
    flush.unreachable()
    ((_, script),) = near.asked
    assert script.splitlines()[-1] == f"flush_stale mesh0 {MAC} 1{login}"


def test_without_restarting_radios_neighbors_are_queried_only_after_a_reboot() -> None:
    near = Neighbors({"b02": node("b02"), "b01": node("b01", "b02")})
    flush = near.flushes.listener(near.job, NO_RADIOS)
    flush.started()
    flush.unreachable()
    flush.ended(node("b02"))
    assert near.asked == []
    flush.ended(node("b02"), rebooted=True)
    assert near.names == ["b01"]


def test_a_node_that_loses_its_power_before_its_change_starts_has_its_neighbors_queried(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Seen on real OpenWrt: packages were being staged, and the node, back in its mesh, was unreachable for minutes."""
    now_s = [1000.0]
    monkeypatch.setattr("meshctl.apply.station_flush.time", SimpleNamespace(monotonic=lambda: now_s[0]))
    interfaces = (NetInterface("lan", up=True, pending=False, addresses=("10.42.0.102/24",)),)
    before = replace(node("b02"), interfaces=interfaces)
    before = replace(before, macs={**(before.macs or {}), "bat0": "76:9f:08:ba:c9:d5"})
    near = Neighbors({"b02": before, "b01": node("b01", "b02")})
    flush = near.flushes.listener(near.job, NO_RADIOS)
    now_s[0] += 30
    flush.unreachable(is_login_due=True)
    ((name, script),) = near.asked
    login = "10.42.0.102 22 76:9f:08:ba:c9:d5"
    assert (name, script.splitlines()[-1]) == ("b01", f"flush_stale mesh0 {MAC} 30 {login}")
    assert near.notes == ["b02: b01 removed a stale entry of its radio"]


def test_an_armed_change_starts_watches_on_the_node_and_on_those_reached_through_it() -> None:
    base = "02:00:00:00:01:00"
    route = Originator(base, MAC, "mesh0", last_seen_ms=100, best=True)
    around = {"b02": node("b02", "b01", "b03"), "b01": node("b01", "b02"), "b03": node("b03", "b02")}
    near = Neighbors({**around, "b03": replace(around["b03"], originators=(route,))}, answer="watching\n")
    near.work.current_base_macs = lambda node: frozenset({base})  # type: ignore[method-assign]
    own: list[str] = []
    connection = watching(own)
    near.flushes.listener(near.job, NO_RADIOS).armed(connection, for_s=100.0)
    assert (own, near.asked) == ([], [])
    near.flushes.listener(near.job, EVERY_RADIO).armed(None, for_s=100.0)
    assert (own, near.names) == ([], ["b03"])
    flush = near.flushes.listener(near.job, EVERY_RADIO)
    flush.armed(connection, for_s=100.0)
    assert ["IS_OWN=yes watch_stale 100" in script for script in own] == [True]
    # on a node that does not change, and has no confirmation of its own
    assert "IS_OWN=yes watch_stale" not in near.asked[-1][1]
    flush.started()
    flush.unreachable()
    # b03 cannot be reached, and watches by itself
    assert near.names == ["b01", "b03", "b03"]


def test_a_node_watches_its_entries_of_nodes_that_restart_at_the_same_moment() -> None:
    """Its part may be called off before its radio restarts. Seen in the lab: after two Ctrl-C in a change of the
    channel, half of the mesh did not hear the other half's unicast for ten minutes."""
    near = Neighbors({"b02": node("b02", "b01"), "b01": node("b01", "b02")})
    own: list[str] = []
    flush = near.flushes.listener(near.job, EVERY_RADIO)
    flush.restarting(["b01", "b02"])
    flush.armed(watching(own), for_s=100.0, is_alone=False)
    assert ["watch_stale 100" in script and MACS["b01"] in script for script in own] == [True]
    # the others may go back after this one is confirmed
    assert "IS_OWN=yes watch_stale" not in own[0]


def test_a_node_that_went_back_has_the_nodes_queried_that_restarted_with_it() -> None:
    """They know its radio from between its two restarts."""
    near = Neighbors({"b02": node("b02", "b01"), "b01": node("b01", "b02")})
    flush = near.flushes.listener(near.job, EVERY_RADIO)
    flush.restarting(["b01", "b02"])
    flush.started()
    flush.ended(node("b02", "b01"))
    assert near.names == []
    flush.ended(node("b02", "b01"), went_back=True)
    assert near.names == ["b01"]


def test_unobserved_neighbors_are_queried_when_the_node_is_back() -> None:
    near = Neighbors({"b02": node("b02", "b01", "b03"), "b01": node("b01", "b02")}, silent=("b03",))
    flush = near.flushes.listener(near.job, EVERY_RADIO)
    flush.started()
    flush.unreachable()
    assert near.names == ["b01"]
    near.silent.clear()
    flush.ended(node("b02", "b04"))
    # b03 was heard before, b04 is heard now: neither was observed, so each checks all of its interfaces
    assert near.names == ["b01", "b01", "b03", "b04"]
    assert all("iw dev 2>/dev/null" in script for name, script in near.asked if name != "b01")
    assert near.flushes.retry_unanswered(near.work) == {}


def test_unanswered_queries_are_retried_at_the_end_and_the_rest_is_reported() -> None:
    near = Neighbors({"b02": node("b02", "b01", "b03", "b04"), "b01": node("b01", "b02")}, silent=("b01", "b03", "b04"))
    flush = near.flushes.listener(near.job, EVERY_RADIO)
    flush.started()
    flush.ended(node("b02"))
    assert near.asked == []
    assert near.notes == []
    near.silent = {"b03", "b04"}
    assert near.flushes.retry_unanswered(near.work) == {"b02": ("b03", "b04")}
    assert near.names == ["b01"]
    assert near.notes == [
        "b02: b01 removed a stale entry of its radio",
        "b02: b03 and b04 did not answer and may hold a stale entry of its radio: "
        "unicast frames to them may be lost for minutes",
    ]


def test_login_time_counts_toward_the_age_threshold_of_an_entry(monkeypatch: pytest.MonkeyPatch) -> None:
    near = Neighbors({"b02": node("b02"), "b01": node("b01", "b02")})
    now_s = [1000.0]
    monkeypatch.setattr("meshctl.apply.station_flush.time", SimpleNamespace(monotonic=lambda: now_s[0]))
    flush = near.flushes.listener(near.job, EVERY_RADIO)
    flush.started()
    now_s[0] += 10.0
    near.log_in = lambda: now_s.__setitem__(0, now_s[0] + 7.0)
    flush.ended(node("b02"))
    assert f"flush_stale mesh0 {MAC} 17\n" in near.asked[0][1]


def test_a_neighbor_that_cannot_remove_its_entry_is_reported() -> None:
    near = Neighbors({"b02": node("b02"), "b01": node("b01", "b02")}, answer=f"kept {MAC}\n")
    flush = near.flushes.listener(near.job, EVERY_RADIO)
    flush.started()
    flush.ended(node("b02"))
    assert near.notes == ["b02: b01 cannot remove its stale entry: unicast frames to them may be lost for minutes"]


def test_an_unverifiable_entry_is_removed_only_for_an_observed_restart() -> None:
    for index, has_restarted in ((7, False), (8, True)):
        near = Neighbors({"b02": node("b02"), "b01": node("b01", "b02")}, answer=f"unknown {MAC}\n")
        flush = near.flushes.listener(near.job, EVERY_RADIO)
        flush.started()
        flush.ended(replace(node("b02", "b01"), ifindexes={"mesh0": index}))
        assert ["flush_restarted mesh0" in script for _, script in near.asked] == [False, True][: 1 + has_restarted]


def test_a_change_without_an_observed_end_is_flushed_later_if_the_radio_has_restarted() -> None:
    same = Neighbors({"b02": node("b02", "b01", connected_s=500)})
    same.flushes.flush_later(same.job, ago_s=100.0)
    assert same.asked == []
    again = Neighbors({"b02": node("b02", "b01", connected_s=50)})
    again.flushes.flush_later(again.job, ago_s=100.0)
    assert again.names == ["b01"]
    assert re.search(r"flush_stale .* 10[01]\n", again.asked[0][1])


def test_entries_from_before_a_boot_are_flushed_later(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("meshctl.apply.station_flush.time", SimpleNamespace(monotonic=lambda: 0.0, time=lambda: 1003.0))
    seen = replace(node("b02", "b01"), asked_at_s=1000.0, uptime_s=40.0)
    booted = Neighbors({"b02": seen})
    booted.flushes.flush_later(booted.job, ago_s=500.0)
    assert re.search(r"flush_stale .* 43\n", booted.asked[0][1])


def test_current_and_recently_heard_neighbors_are_observed() -> None:
    seen = {"b02": node("b02", "b01")}
    known = {
        "b02": LastKnown("b02", 1000.0, {"macs": MAC, "neighbours": f"{MACS['b03'].upper()} {MACS['b01']}"}),
        "b01": LastKnown("b01", 1.0, {"macs": MACS["b01"]}),
        "b03": LastKnown("b03", 1.0, {"macs": MACS["b03"]}),
    }
    assert known_neighbors(fleet(), seen, known, now_s=1000.0 + REMEMBERED_S - 1) == ("b01", "b03")
    assert known_neighbors(fleet(), seen, known, now_s=1000.0 + REMEMBERED_S + 1) == ("b01",)


def test_radios_are_matched_by_name_unless_every_radio_is_selected() -> None:
    assert "mesh7" in EVERY_RADIO
    assert "mesh1" not in Radios(frozenset({"mesh0"}))


def test_a_connection_that_a_late_timer_closes_is_not_used_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """The answer came just as the timer fired: the connection was in the pool, and then closed under its next user."""
    is_closing, may_close = threading.Event(), threading.Event()
    connection, released = SimpleNamespace(is_open=True), list[bool]()

    def close() -> None:
        is_closing.set()
        assert may_close.wait(60)
        connection.is_open = False

    def run(script: str, *, timeout_s: float) -> SimpleNamespace:
        assert is_closing.wait(60)
        threading.Timer(0.2, may_close.set).start()
        return SimpleNamespace(stdout=f"gone {MAC}\n")

    connection.close, connection.run = close, run
    monkeypatch.setattr(station_flush, "QUERY_TIMEOUT_S", 0.0)
    neighbors = Neighbors({})
    pool = cast("SimpleNamespace", neighbors.work.connections)
    pool.acquire, pool.release = lambda _: connection, lambda _, kept: released.append(kept.is_open)
    assert station_flush._query_one(neighbors.work, "b01", str) == f"gone {MAC}"
    assert released == [False]
