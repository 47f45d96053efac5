"""A change in progress: what each look at the node leaves behind for the outcome."""

from __future__ import annotations

import time
from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import pytest

from meshctl.apply import change_in_progress, commit_confirm
from meshctl.apply.change_in_progress import (
    LOCK_SLACK_S,
    ROLLBACK_S,
    ChangeInProgress,
    arm,
    connect,
    observe_and_decide,
    start,
)
from meshctl.apply.change_listener import ChangeListener
from meshctl.apply.commit_confirm import _observe_once, _uncertain
from meshctl.apply.context import NodeContext
from meshctl.apply.health_checks import Expectation
from meshctl.apply.next_action import Action
from meshctl.device import deadman
from meshctl.device.connection import Deadlines, Endpoint
from meshctl.device.deadman import Change, NewFile
from meshctl.device.errors import AuthenticationRefused
from meshctl.device.observation import ChangeStatus, NetInterface, Observation
from meshctl.device.ssh import SshConnection
from meshctl.errors import Unreachable
from meshctl.fleet import Interrupt, Outcome, Result
from meshctl.model import Secret
from meshctl.nodes.backoff import Backoff
from meshctl.nodes.slots import ChannelSlots
from meshctl.plan import Cut
from meshctl.render import LAN_FILTER_PATH
from meshctl.uci import parse

NETWORK = """
config interface 'lan'
	option device 'br-lan'
	option ipaddr '10.42.0.101'
"""
HERE = Endpoint("10.42.0.101")
CONNECTION = cast("SshConnection", SimpleNamespace(endpoint=HERE))


def a_change() -> ChangeInProgress:
    listener = SimpleNamespace(observed=lambda: None)
    run = SimpleNamespace(
        new_listener=lambda *_: listener,
        current_base_macs=lambda _: frozenset(),
        interrupt=SimpleNamespace(leaving=False),
    )
    ctx = SimpleNamespace(run=run, node=None, expected=Expectation(network=parse(NETWORK, "network")))
    return ChangeInProgress(
        cast("NodeContext", ctx), Change("c1", {}, "exit 0\n"), Secret("nonce"), 60, HERE, (HERE,), is_reloaded=True
    )


def looked_at(change: ChangeInProgress, monkeypatch: pytest.MonkeyPatch, status: ChangeStatus, address: str) -> Action:
    lan = NetInterface("lan", up=True, pending=False, addresses=(address,))
    seen = Observation(0.0, 0.1, interfaces=(lan,), bridges=(), change=status)
    monkeypatch.setattr(change_in_progress, "observe", lambda _, **__: seen)
    return observe_and_decide(change, CONNECTION, is_opened_after_reload=True)


def test_what_a_node_lacks_after_its_rollback_is_not_given_as_the_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    restored = ChangeStatus("idle", last_id="c1", last_outcome="restored", last_reason="timeout")
    never_seen = a_change()
    assert looked_at(never_seen, monkeypatch, restored, "192.168.1.1/24") is Action.WENT_BACK
    assert never_seen.unmet == ()
    seen = a_change()
    applied = ChangeStatus("applied", "c1", window_s=60, left_s=20.0, reload_status=0)
    assert looked_at(seen, monkeypatch, applied, "10.42.0.99/24") is Action.WAIT
    assert looked_at(seen, monkeypatch, restored, "192.168.1.1/24") is Action.WENT_BACK
    assert seen.unmet == ("its LAN has 10.42.0.99/24, not 10.42.0.101",)


def test_an_applied_change_is_checked_even_if_its_age_is_unknown(monkeypatch: pytest.MonkeyPatch) -> None:
    change = a_change()
    unknown = ChangeStatus("applied", "c1", reload_status=0)
    assert looked_at(change, monkeypatch, unknown, "192.168.1.1/24") is Action.WAIT
    assert change.unmet == ("its LAN has 192.168.1.1/24, not 10.42.0.101",)


def test_a_look_waits_for_the_end_of_the_reload_without_a_slot(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each login at a slow node slows its reload."""
    slots, waits, held = ChannelSlots(), [], []

    def status(_: SshConnection, *, started: str, await_reload_s: int) -> ChangeStatus:
        assert started == "c1"
        waits.append(await_reload_s)
        held.append(slots._group("").in_use)
        return ChangeStatus("applied", "c1", window_s=60, left_s=20.0, reload_status=0)

    monkeypatch.setattr(deadman, "status", status)
    for is_reloaded, is_abandoned, leaving in (
        (False, False, False),
        (True, False, False),
        (False, True, False),
        (False, False, True),
    ):
        change = a_change()
        change.is_reloaded, change.is_abandoned = is_reloaded, is_abandoned
        cast("SimpleNamespace", change.ctx.run.interrupt).leaving = leaving
        with slots.use("b01") as slot:
            change_in_progress._while_it_reloads(change, CONNECTION, slot)
    assert waits == [5, 0, 0, 0]
    assert held == [0, 1, 1, 1]


@pytest.mark.parametrize("address", ["10.42.0.101", "192.168.1.1"])
def test_only_a_connection_to_the_new_address_is_kept(monkeypatch: pytest.MonkeyPatch, address: str) -> None:
    """One to the former address, which the node may still have for a while, would never find it at the new one."""
    change = a_change()
    change.old = Endpoint("192.168.1.1")
    cast("SimpleNamespace", change.ctx).name = "b01"
    change.listener = cast("ChangeListener", SimpleNamespace(connecting=nullcontext))
    closed: list[str] = []
    connection = SimpleNamespace(endpoint=Endpoint(address), is_open=True, close=lambda: closed.append(address))
    monkeypatch.setattr(commit_confirm, "connect", lambda _: connection)
    monkeypatch.setattr(commit_confirm, "observe_and_decide", lambda *_, **__: Action.WAIT)
    kept = _observe_once(change, None, ChannelSlots().acquire("b01"))
    assert kept == (None, connection if address == "10.42.0.101" else None)
    assert closed == ([] if address == "10.42.0.101" else ["192.168.1.1"])


def logins_of(change: ChangeInProgress) -> dict[str, Deadlines]:
    """The time limits with which a change logs in at each address, where no node answers."""
    limits = {}

    def open_at(_: object, *, endpoint: Endpoint, deadlines: Deadlines) -> SshConnection:
        limits[endpoint.host] = deadlines
        raise Unreachable("no route to host")

    cast("SimpleNamespace", change.ctx.run).connections = SimpleNamespace(open=open_at, deadlines=Deadlines())
    assert connect(change) is None
    return limits


def test_a_login_that_hangs_at_the_old_address_leaves_most_of_the_confirm_window() -> None:
    """Another device has it by now, or the node's server is going down there."""
    change = a_change()
    change.old = Endpoint("192.168.1.1")
    change.started_s = time.monotonic()
    limits = logins_of(change)
    assert limits["10.42.0.101"] == Deadlines()
    old = limits["192.168.1.1"]
    assert old.connect_s + old.handshake_s + old.auth_s < change.window_s / 4


def test_a_slow_node_that_has_rolled_back_gets_all_the_time_at_its_old_address() -> None:
    change = a_change()
    change.old = Endpoint("192.168.1.1")
    change.started_s = time.monotonic() - change.window_s - 1
    assert logins_of(change)["192.168.1.1"] == Deadlines()


@pytest.mark.parametrize(("late_s", "refused"), [(-10.0, "b01: login refused"), (1.0, "")])
def test_a_login_that_is_refused_while_the_change_is_rolled_back_is_not_given_as_the_reason(
    late_s: float, refused: str
) -> None:
    """Seen in a bootstrap on a busy machine: the operator's key was gone because the window had run out."""
    change = a_change()
    change.started_s = time.monotonic() - change.window_s - late_s

    def refuse(*_: object, **__: object) -> None:
        raise AuthenticationRefused("b01: login refused")

    cast("SimpleNamespace", change.ctx.run).connections = SimpleNamespace(open=refuse, deadlines=Deadlines())
    assert connect(change) is None
    assert (change.login_refused, change.connect_error) == (refused, refused)
    assert change.last_error == "b01: login refused"


@pytest.mark.parametrize(
    ("files", "is_due"),
    [
        (("etc/config/wireless", "etc/config/dropbear", "etc/config/system"), True),
        # packages
        ((), True),
        (("etc/config/wireless", "etc/config/firewall"), False),
        (("etc/config/network",), False),
        ((LAN_FILTER_PATH,), False),
    ],
)
def test_neighbors_try_to_log_in_unless_the_change_may_drop_logins(files: tuple[str, ...], is_due: bool) -> None:
    """Seen on real OpenWrt: a radio restarted, its neighbor dropped SSH alone, and a good change was rolled back."""
    calls = list[bool]()
    change = a_change()
    change.payload = replace(change.payload, files={f"/{path}": NewFile(b"") for path in files})
    change.started_s = time.monotonic()
    listener = cast("SimpleNamespace", change.listener)
    listener.connecting = nullcontext
    listener.unreachable = lambda *, is_login_due: calls.append(is_login_due)

    def refuse(*_: object, **__: object) -> None:
        raise Unreachable("no answer")

    cast("SimpleNamespace", change.ctx.run).connections = SimpleNamespace(open=refuse, deadlines=Deadlines())
    assert _observe_once(change, None, ChannelSlots().acquire("b01")) == (None, None)
    # its timer has rolled it back
    change.started_s -= change.window_s + ROLLBACK_S + 1
    assert _observe_once(change, None, ChannelSlots().acquire("b01")) == (None, None)
    assert calls == [is_due, True]


def test_a_node_that_stays_unreachable_before_its_change_has_started_was_not_changed() -> None:
    """Seen on a virtual fleet: it was uncertain, and its timer had allegedly rolled back what it had never started."""
    run = SimpleNamespace(interrupt=SimpleNamespace(leaving=False))
    change = SimpleNamespace(ctx=SimpleNamespace(name="b01", run=run), started_s=None, last_error="no route to host")
    outcome = _uncertain(cast("ChangeInProgress", change))
    assert outcome == Outcome("b01", Result.FAILED, "nothing was changed: no route to host")


@pytest.mark.parametrize(
    ("last_id", "outcome"),
    [
        ("c0", Outcome("b01", Result.FAILED, "nothing was changed")),
        ("c1", Outcome("b01", Result.ROLLED_BACK, "its power was cut, or it rebooted, before it was confirmed")),
    ],
)
def test_a_change_that_left_no_trace_does_not_get_the_reason_of_an_earlier_one(
    monkeypatch: pytest.MonkeyPatch, last_id: str, outcome: Outcome
) -> None:
    """Seen on real OpenWrt: b01's power was cut as a switch was armed, and it `rolled back: it was canceled`."""
    status = ChangeStatus("idle", last_id=last_id, last_outcome="restored", last_reason="boot")
    monkeypatch.setattr(commit_confirm, "observe_and_decide", lambda *_, **__: Action.WENT_BACK)
    monkeypatch.setattr(commit_confirm, "unlock", lambda *_: None)
    ctx = SimpleNamespace(name="b01", before=Observation(0.0, 0.1))
    change = SimpleNamespace(
        ctx=ctx, id="c1", started_s=None, status=status, unmet=(), login_refused="", connect_error="", last=None
    )
    connection, slot = cast("SshConnection", None), ChannelSlots().acquire("b01")
    assert commit_confirm._act(cast("ChangeInProgress", change), connection, slot, is_proof=False) == outcome


def test_the_window_of_a_scheduled_change_begins_at_its_moment(monkeypatch: pytest.MonkeyPatch) -> None:
    """The order comes earlier, by as much as the slowest of many nodes needs, which may be longer than the window."""
    change = a_change()
    cast("SimpleNamespace", change.listener).started = lambda: None
    run = cast("SimpleNamespace", change.ctx.run)
    run.owner, run.connections = "alice", SimpleNamespace(slots=ChannelSlots())
    ctx = cast("SimpleNamespace", change.ctx)
    ctx.name, ctx.step, ctx.plan = "b01", lambda _: nullcontext(), SimpleNamespace(cut=Cut.NOTHING)
    monkeypatch.setattr(deadman, "apply", lambda *_, **__: 0.0)
    ordered_s = time.monotonic() - change.window_s - ROLLBACK_S - 1
    connection = cast("SshConnection", SimpleNamespace(close=lambda: None))
    start(change, connection, at_uptime_s=100.0, due_s=ordered_s + 3600.0)
    assert (change.is_window_over, change.is_undone) == (False, False)
    limits: list[float] = []

    def over(limit_s: float, interrupt: Interrupt) -> Backoff:
        limits.append(limit_s)
        return Backoff(0.0, interrupt)

    monkeypatch.setattr(commit_confirm, "Backoff", over)
    run.interrupt = Interrupt()
    assert commit_confirm.poll(change).result is Result.UNCERTAIN
    # one that is canceled is polled until its own end
    assert limits[0] > 3400.0 - ROLLBACK_S + change.window_s


def test_the_lock_lasts_while_a_node_waits_for_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    """Seen in the sources: the first of many nodes dropped its armed change before the last one was armed."""
    change = a_change()
    ctx = cast("SimpleNamespace", change.ctx)
    ctx.step = lambda _: nullcontext()
    ctx.run.owner, ctx.run.rate_bytes_per_s, ctx.progress = "alice", None, None
    locks: list[int] = []
    for name in ("await_first_boot", "install_switch"):
        monkeypatch.setattr(change_in_progress, name, lambda *_: None)
    for name in ("stage", "arm"):
        monkeypatch.setattr(deadman, name, lambda *_, **__: None)
    monkeypatch.setattr(deadman, "lock", lambda *_, ttl_s: locks.append(ttl_s))
    for held_s in (0.0, 300.5):
        change.held_s = held_s
        arm(change, CONNECTION)
    assert locks == [60 + LOCK_SLACK_S, 60 + LOCK_SLACK_S + 301]
