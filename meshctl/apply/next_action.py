"""What to do next about a change on a node, from what its dead-man's switch says. Pure.

Whatever was cut (the connection, the node's power, meshctl itself), the switch's state tells the truth, so the driver
only ever asks and follows: `next_move` has no memory.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum

from meshctl.device.observation import ChangeStatus


class Action(Enum):
    """START: nothing of ours is armed, send it. BEGIN: it is armed and waits for the word. WAIT: it is on its way.
    CONFIRM: it has proven itself. ABORT: it never will. KEPT, WENT_BACK: it has ended. FOREIGN: somebody else's change
    is in the way."""

    START = "start"
    BEGIN = "begin"
    WAIT = "wait"
    CONFIRM = "confirm"
    ABORT = "abort"
    KEPT = "kept"
    WENT_BACK = "went back"
    FOREIGN = "foreign"


# Too little of the window left to prove anything more: take it back now instead of waiting for the timer.
MIN_PROOF_S = 3.0


def next_action(
    change_id: str,
    status: ChangeStatus,
    missing: Sequence[str],
    *,
    is_at_new_address: bool,
    leaving: bool = False,
    is_given_up: bool = False,
) -> Action:
    """The next move for change `change_id`. `missing` is what has not come back yet (only counts once applied);
    `is_at_new_address` whether the answer came from where the node shall be; `leaving` that nobody will wait;
    `is_given_up` that the change is not wanted any more, whatever it proves."""
    start = Action.WENT_BACK if is_given_up else Action.START
    if not status.installed:
        return start
    if status.change_id == change_id:
        match status.state:
            case "staged":
                return Action.ABORT if is_given_up else Action.START
            case "armed":
                return Action.ABORT if is_given_up else Action.BEGIN
            case "applied":
                if is_given_up:
                    return Action.ABORT
                return _applied(status, missing, is_at_new_address=is_at_new_address, leaving=leaving)
            case _:
                return Action.ABORT if is_given_up and status.state == "waiting" else Action.WAIT
    if status.last_id == change_id:
        return Action.KEPT if status.last_outcome == "confirmed" else Action.WENT_BACK
    if status.state in ("armed", "waiting", "applied", "restoring"):
        return Action.FOREIGN
    return start


def _applied(status: ChangeStatus, missing: Sequence[str], *, is_at_new_address: bool, leaving: bool) -> Action:
    if not missing and is_at_new_address:
        return Action.CONFIRM
    failed = status.reload_status not in (None, 0)
    late = status.left_s is not None and status.left_s < MIN_PROOF_S
    return Action.ABORT if failed or late or leaving else Action.WAIT


def applied_age_s(status: ChangeStatus) -> float | None:
    """For how long an applied change has stood, in whole seconds; None when none is applied."""
    if status.state != "applied" or status.window_s is None or status.left_s is None:
        return None
    return max(0.0, status.window_s - status.left_s)


# How the switch's own words read to a person.
REASONS = {
    "timeout": "it was not confirmed in time",
    "abort": "it was taken back",
    "boot": "its power was cut, or it rebooted, before it was confirmed",
    "guard": "its timer was killed; its second timer took over",
    "failed": "the files could not be put in place, or the packages not be installed",
    "moved-on": "somebody changed a file on it meanwhile",
    "operator": "it was dropped",
}


def rollback_reason(status: ChangeStatus, missing: Sequence[str], shut_out: str = "", unreached: str = "") -> str:
    """One sentence for an outcome. `shut_out` is that it let nobody in while the change was in force: what was missing
    was then seen too late, after it went back. `unreached` is why it could not be reached at all."""
    word, _, rest = status.last_reason.partition("+")
    reason = REASONS.get(word, word or "for an unknown reason")
    if rest:
        reason += ", and packages that it installed could not be removed"
    details = shut_out or "; ".join(missing) or (unreached and f"it could not be reached: {unreached}")
    return f"{reason}: {details}" if details else reason
