"""Change one node's configuration so that every way out but a proof leads back to what it had.

`configure` sends the change over the connection at hand and begins it, then follows the node's own dead-man's switch
over new connections (`follow`) until the change is confirmed or undone. A cut at any point ends in the same loop: it
asks the node what is, and does what is next. While the node is silent, and once it is back, its neighbours are asked to
forget the radio it had (`forgetting`).
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace

from meshctl.apply.change_in_progress import (
    ChangeInProgress,
    abort,
    arm,
    confirm,
    connect,
    new_change,
    observe_and_decide,
    start,
    unlock,
)
from meshctl.apply.context import NodeContext
from meshctl.apply.next_action import Action, rollback_reason
from meshctl.device.errors import NodeRefused
from meshctl.device.ssh import SshConnection
from meshctl.errors import NodeError, Unreachable
from meshctl.fleet import Outcome, Result
from meshctl.nodes.backoff import Backoff

# After the window: the node puts its files back, reloads, and its mesh finds it again; a reboot when that fails.
GRACE_AFTER_WINDOW_S = 60.0
# A link that breaks again and again before anything began is given up after so many starts.
MAX_STARTS = 3


def configure(job: NodeContext, connection: SshConnection) -> Outcome:
    """Carry out the file changes of a node's plan. Owns `connection`, and keeps one to the node if all went well.

    Raises NodeError only when nothing was changed on the node.
    """
    # a device that was met on the bench is known by its name from now on
    return run_change(new_change(job, replace(connection.endpoint, identity=job.name)), connection)


def run_change(attempt: ChangeInProgress, connection: SshConnection) -> Outcome:
    """Carry a change to its end. Owns `connection`, and keeps one to the node if all went well.

    Raises NodeError only when nothing was changed on the node.
    """
    job = attempt.ctx
    try:
        arm(attempt, connection)
        if attempt.radios:
            attempt.flush.watch_own_entries(connection, for_s=_limit_s(attempt))
            attempt.flush.watch(for_s=_limit_s(attempt))
        start(attempt, connection)
    except Unreachable as error:
        # how far it came, the node itself will tell
        attempt.last_error = str(error)
    except NodeRefused as refusal:
        unlock(attempt, connection)
        return Outcome(job.name, Result.REFUSED, str(refusal), hint=refusal.hint)
    except NodeError:
        unlock(attempt, connection)
        raise
    finally:
        connection.close()
    with job.step("prove"):
        return poll(attempt)


def poll(attempt: ChangeInProgress) -> Outcome:
    """Ask and do what is next until the change has ended one way or the other."""
    work = attempt.ctx.run
    pace = Backoff(_limit_s(attempt), work.interrupt)
    work.interrupt.wait(attempt.settle_s)
    while not pace.is_over:
        with attempt.flush.flush_if_slow():
            connection = connect(attempt)
        if connection is not None:
            try:
                outcome = _act(attempt, connection)
            except Unreachable as error:
                attempt.last_error, outcome = str(error), None
            finally:
                connection.close()
            if attempt.last is not None:
                work.record(attempt.ctx.name, attempt.last)
            if outcome is not None:
                _flush_stations(attempt, outcome)
                return outcome
        else:
            attempt.flush.unreachable()
        if work.interrupt.leaving:
            break
        pace.pause()
    return _uncertain(attempt)


def _act(attempt: ChangeInProgress, connection: SshConnection) -> Outcome | None:
    """Look at the node once and make the next move; an outcome when it was the last."""
    name = attempt.ctx.name
    match observe_and_decide(attempt, connection):
        case Action.CONFIRM:
            return Outcome(name, Result.DONE) if confirm(attempt) else None
        case Action.ABORT:
            abort(attempt, connection)
        case Action.KEPT:
            unlock(attempt, connection)
            return Outcome(name, Result.DONE)
        case Action.WENT_BACK:
            unlock(attempt, connection)
            why = rollback_reason(attempt.status, attempt.unmet, attempt.login_refused, attempt.connect_error)
            return Outcome(name, Result.ROLLED_BACK, why)
        case Action.FOREIGN:
            status = attempt.status
            return Outcome(name, Result.REFUSED, f"a change of {status.owner} is {status.state} on it")
        case Action.START | Action.BEGIN as move:
            return _resend(attempt, connection, move)
        case Action.WAIT:
            pass
    return None


def _resend(attempt: ChangeInProgress, connection: SshConnection, move: Action) -> Outcome | None:
    """The node has nothing of ours that would begin by itself: send what is missing again, a few times."""
    name = attempt.ctx.name
    if attempt.starts >= MAX_STARTS:
        with suppress(NodeError):
            abort(attempt, connection)
        unlock(attempt, connection)
        return Outcome(name, Result.FAILED, f"its link breaks before the change is there: {attempt.last_error}")
    try:
        if move is Action.START:
            arm(attempt, connection)
        else:
            attempt.starts += 1
        start(attempt, connection)
    except NodeRefused as refusal:
        abort(attempt, connection)
        unlock(attempt, connection)
        return Outcome(name, Result.REFUSED, str(refusal), hint=refusal.hint)
    return None


def _limit_s(attempt: ChangeInProgress) -> float:
    """Within this time the change has been confirmed or undone."""
    return attempt.settle_s + attempt.extra_s + attempt.window_s + GRACE_AFTER_WINDOW_S


def _flush_stations(attempt: ChangeInProgress, outcome: Outcome) -> None:
    if outcome.result in (Result.DONE, Result.ROLLED_BACK):
        attempt.flush.ended(
            attempt.last,
            went_back=outcome.result is Result.ROLLED_BACK,
            rebooted=attempt.last is not None and attempt.last.boot_id != attempt.ctx.before.boot_id,
        )


def _uncertain(attempt: ChangeInProgress) -> Outcome:
    if attempt.ctx.run.interrupt.leaving:
        why = f"left while its change was under way; it goes back by itself within {attempt.window_s} s"
    else:
        why = f"not seen since its change began ({attempt.last_error}); by its own timer it has gone back"
    return Outcome(attempt.ctx.name, Result.UNCERTAIN, why, hint="`meshctl resume` looks at it again")
