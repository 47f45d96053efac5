"""The state of the node's switch decides the next action, and no change is confirmed that has not proven itself."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from meshctl.apply.health_checks import RELOADING
from meshctl.apply.next_action import Action, applied_age_s, flashed_by_others, next_action, rollback_reason
from meshctl.device.observation import ChangeStatus, Observation, ReleaseInfo

APPLIED = ChangeStatus("applied", "c1", owner="me", window_s=60, left_s=40.0, reload_status=0)
STATES = ("idle", "staged", "armed", "waiting", "applied", "restoring", "absent")


def move(
    status: ChangeStatus, *missing: str, new: bool = True, leaving: bool = False, given_up: bool = False
) -> Action:
    return next_action("c1", status, missing, is_at_new_address=new, leaving=leaving, is_abandoned=given_up)


@st.composite
def statuses(draw: st.DrawFn) -> ChangeStatus:
    ids = st.sampled_from(["", "c1", "c2"])
    return ChangeStatus(
        draw(st.sampled_from(STATES)),
        draw(ids),
        window_s=60,
        left_s=draw(st.one_of(st.none(), st.floats(-5, 60))),
        reload_status=draw(st.sampled_from([None, 0, 1])),
        last_id=draw(ids),
        last_outcome=draw(st.sampled_from(["", "confirmed", "restored"])),
        installed=draw(st.booleans()),
    )


@given(statuses(), st.lists(st.sampled_from(["lan", "base"])), st.booleans(), st.booleans(), st.booleans())
def test_only_our_own_applied_and_verified_change_at_the_new_address_is_confirmed(
    status: ChangeStatus, missing: list[str], new: bool, leaving: bool, given_up: bool
) -> None:
    chosen = move(status, *missing, new=new, leaving=leaving, given_up=given_up)
    if chosen is Action.CONFIRM:
        assert status.installed
        assert (status.state, status.change_id) == ("applied", "c1")
        assert new
        assert not missing
        assert not given_up


@given(statuses(), st.booleans())
def test_an_abandoned_change_is_never_sent_started_or_confirmed(status: ChangeStatus, new: bool) -> None:
    assert move(status, new=new, given_up=True) not in (Action.START, Action.BEGIN, Action.CONFIRM)


@pytest.mark.parametrize(
    ("status", "expected"),
    [
        (ChangeStatus("absent", installed=False), Action.START),
        (ChangeStatus("idle"), Action.START),
        (ChangeStatus("staged", "c1"), Action.START),
        (ChangeStatus("staged", "c2"), Action.START),
        (ChangeStatus("armed", "c1"), Action.BEGIN),
        (ChangeStatus("waiting", "c1"), Action.WAIT),
        (ChangeStatus("restoring", "c1"), Action.WAIT),
        (APPLIED, Action.CONFIRM),
        (ChangeStatus("applied", "c2", owner="bob"), Action.FOREIGN),
        (ChangeStatus("idle", last_id="c1", last_outcome="confirmed"), Action.KEPT),
        (ChangeStatus("idle", last_id="c1", last_outcome="restored", last_reason="boot"), Action.WENT_BACK),
        (ChangeStatus("applied", "c2", last_id="c1", last_outcome="restored"), Action.WENT_BACK),
    ],
)
def test_each_state_of_the_switch_maps_to_its_next_action(status: ChangeStatus, expected: Action) -> None:
    assert move(status) is expected


def test_an_unverified_change_gets_its_full_window_and_is_then_aborted() -> None:
    assert move(APPLIED, "no neighbor") is Action.WAIT
    assert move(replace(APPLIED, left_s=2.0), "no neighbor") is Action.ABORT
    assert move(replace(APPLIED, reload_status=1), "no neighbor") is Action.ABORT
    assert move(APPLIED, "no neighbor", leaving=True) is Action.ABORT
    assert move(APPLIED, new=False) is Action.WAIT


def test_the_age_of_a_change_is_the_elapsed_part_of_its_window() -> None:
    assert applied_age_s(APPLIED) == 20.0
    assert applied_age_s(ChangeStatus("waiting", "c1", window_s=60)) is None


def test_the_rollback_reason_is_human_readable() -> None:
    status = ChangeStatus("idle", last_id="c1", last_outcome="restored", last_reason="boot")
    assert rollback_reason(status, ()) == "its power was cut, or it rebooted, before it was confirmed"
    late = replace(status, last_reason="timeout")
    assert rollback_reason(late, ("its LAN is down",)) == "it was not confirmed in time: its LAN is down"


def test_a_change_that_never_came_into_force_is_not_explained_by_a_failed_check() -> None:
    """Seen on 25.12.5: apk found no room in flash, and the message ended with "its services are still reloading"."""
    status = ChangeStatus("idle", last_id="c1", last_outcome="restored", last_reason="flash-full")
    assert rollback_reason(status, (RELOADING,)) == "its flash has no room for the packages"
    stays = replace(status, last_reason="failed+packages-stay")
    assert rollback_reason(stays, ("its LAN is down",)).endswith("installed could not be removed")


def test_a_rollback_by_a_foreign_sysupgrade_names_both_builds() -> None:
    def running(revision: str) -> Observation:
        return Observation(0.0, 0.0, release=ReleaseInfo("OpenWrt", "24.10.7", revision, "ath79/generic"))

    assert (
        flashed_by_others(running("r29087"), running("r30000"))
        == "someone else flashed it from r29087 to r30000 meanwhile; "
    )
    assert flashed_by_others(running("r29087"), running("r29087")) == ""
    assert flashed_by_others(running("r29087"), None) == ""
    assert flashed_by_others(Observation(0.0, 0.0), running("r30000")) == ""


def test_a_refused_login_takes_precedence_over_unmet_checks() -> None:
    late = ChangeStatus("idle", last_id="c1", last_outcome="restored", last_reason="timeout")
    reason = rollback_reason(late, ("its LAN is down",), "b01: login refused for root; tried: key a")
    assert reason == "it was not confirmed in time: b01: login refused for root; tried: key a"


def test_the_checks_that_caused_an_abort_take_precedence_over_a_login_refused_after_it() -> None:
    aborted = ChangeStatus("idle", last_id="c1", last_outcome="restored", last_reason="abort")
    reloading = "reloading its services failed with exit status 1"
    assert rollback_reason(aborted, (reloading,), "login refused for root") == f"it was aborted: {reloading}"
    assert rollback_reason(aborted, (), "login refused for root") == "it was aborted: login refused for root"


def test_the_connection_error_is_reported_only_if_no_check_was_unmet() -> None:
    late = ChangeStatus("idle", last_id="c1", last_outcome="restored", last_reason="timeout")
    reason = rollback_reason(late, (), "", "cannot connect: Connection refused")
    assert reason == "it was not confirmed in time: it was unreachable: cannot connect: Connection refused"
    assert "reached" not in rollback_reason(late, ("its LAN is down",), "", "cannot connect")
    # it was still reloading when it was last reached
    assert rollback_reason(late, (RELOADING,), "", "cannot connect") == reason.replace(": Connection refused", "")
    assert rollback_reason(late, (RELOADING,)) == (
        "it was not confirmed in time: its services are still reloading: it needs a longer confirm_window_s"
    )
