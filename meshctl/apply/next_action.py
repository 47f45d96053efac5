"""The next action for a change on a node, from the state of its dead-man's switch. Pure.

The switch's state is the truth whatever was cut (the connection, the node's power, meshctl itself), so `next_action`
has no memory.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum

from meshctl.apply.health_checks import NEEDS_LONGER_WINDOW, RELOADING
from meshctl.device.observation import ChangeStatus, Observation


class Action(Enum):
    """START: nothing of ours is armed, arm it. BEGIN: it is armed, start it. WAIT: it is in progress. CONFIRM: it has
    proven itself. ABORT: it cannot. KEPT, WENT_BACK: it was confirmed or rolled back. FOREIGN: another operator's
    change is in progress."""

    START = "start"
    BEGIN = "begin"
    WAIT = "wait"
    CONFIRM = "confirm"
    ABORT = "abort"
    KEPT = "kept"
    WENT_BACK = "went back"
    FOREIGN = "foreign"


# With less of the window left than this nothing can be proven: abort now instead of waiting for the timer.
MIN_PROOF_S = 3.0


def next_action(
    change_id: str,
    status: ChangeStatus,
    unmet: Sequence[str],
    *,
    is_at_new_address: bool,
    leaving: bool = False,
    is_abandoned: bool = False,
) -> Action:
    """The next action for change `change_id`. `unmet` lists the failing health checks (counts only once applied);
    `is_at_new_address` is whether the node answered at its new address; `leaving` that meshctl is about to exit;
    `is_abandoned` that the change must be rolled back, whatever it proves."""
    start = Action.WENT_BACK if is_abandoned else Action.START
    if not status.installed:
        return start
    if status.change_id == change_id:
        match status.state:
            case "staged":
                return Action.ABORT if is_abandoned else Action.START
            case "armed":
                return Action.ABORT if is_abandoned else Action.BEGIN
            case "applied":
                if is_abandoned:
                    return Action.ABORT
                return _applied(status, unmet, is_at_new_address=is_at_new_address, leaving=leaving)
            case _:
                return Action.ABORT if is_abandoned and status.state == "waiting" else Action.WAIT
    if status.last_id == change_id:
        return Action.KEPT if status.last_outcome == "confirmed" else Action.WENT_BACK
    if status.state in ("armed", "waiting", "applied", "restoring"):
        return Action.FOREIGN
    return start


def _applied(status: ChangeStatus, unmet: Sequence[str], *, is_at_new_address: bool, leaving: bool) -> Action:
    if not unmet and is_at_new_address:
        return Action.CONFIRM
    failed = status.reload_status not in (None, 0)
    late = status.left_s is not None and status.left_s < MIN_PROOF_S
    return Action.ABORT if failed or late or leaving else Action.WAIT


def applied_age_s(status: ChangeStatus) -> float | None:
    """How long ago the change was applied, in whole seconds; None when none is applied."""
    if status.state != "applied" or status.window_s is None or status.left_s is None:
        return None
    return max(0.0, status.window_s - status.left_s)


# The switch's reasons, for messages; with these the change has not come into force, and no check says why.
NOT_IN_FORCE = ("failed", "flash-full")
REASONS = {
    "timeout": "it was not confirmed in time",
    "abort": "it was aborted",
    "boot": "its power was cut, or it rebooted, before it was confirmed",
    "guard": "its timer was killed; its second timer took over",
    "expired": "it was armed but not started before its operator's lock expired",
    "failed": "the files could not be written, or the packages could not be installed",
    "flash-full": "its flash has no room for the packages",
    "moved-on": "a file on it was changed by someone else",
    "operator": "it was canceled",
    "unknown": "its flash was too full to store the reason",
}


def reason_text(last_reason: str) -> str:
    """The switch's reason in words, without what follows a `+`."""
    word = last_reason.partition("+")[0]
    return REASONS.get(word, word)


def rollback_reason(
    status: ChangeStatus, unmet: Sequence[str], login_refused: str = "", connect_error: str = ""
) -> str:
    """One sentence for an outcome. `unmet` are the checks that failed in the latest observation of the applied change.
    `login_refused` and `connect_error`: since then, a login was refused, or the node was unreachable.

    An abort is sent because of `unmet`, and what a login says later is its effect: the restored keys are not ours."""
    word, _, rest = status.last_reason.partition("+")
    reason = reason_text(word) or "for an unknown reason"
    if rest:
        reason += ", and the packages it installed could not be removed"
    if word in NOT_IN_FORCE:
        return reason
    # a node whose network has reloaded halfway says no more than that
    reasons = () if connect_error and tuple(unmet) == (RELOADING,) else unmet
    failed = "; ".join(reasons)
    if word == "timeout" and tuple(reasons) == (RELOADING,):
        failed = f"{RELOADING}: {NEEDS_LONGER_WINDOW}"
    first, second = (failed, login_refused) if word == "abort" else (login_refused, failed)
    details = first or second or (connect_error and f"it was unreachable: {connect_error}")
    return f"{reason}: {details}" if details else reason


def flashed_by_others(before: Observation, last: Observation | None) -> str:
    """A clause for a rollback if the node runs another build than before the change, whose reboot undid it; else empty.

    Such a sysupgrade was started by someone else: meshctl itself never flashes a node with an unconfirmed change."""
    release = None if last is None else last.release
    if before.release is None or release is None or before.release.revision == release.revision:
        return ""
    return f"someone else flashed it from {before.release.revision} to {release.revision} meanwhile; "
