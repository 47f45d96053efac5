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


def configure(ctx: NodeContext, connection: SshConnection) -> Outcome:
    """Carry out the file changes of a node's plan. Owns `connection`, and keeps one to the node if all went well.

    Raises NodeError only when nothing was changed on the node.
    """
    # a device that was met on the bench is known by its name from now on
    return run_change(new_change(ctx, replace(connection.endpoint, identity=ctx.name)), connection)


def run_change(change: ChangeInProgress, connection: SshConnection) -> Outcome:
    """Carry a change to its end. Owns `connection`, and keeps one to the node if all went well.

    Raises NodeError only when nothing was changed on the node.
    """
    ctx = change.ctx
    try:
        arm(change, connection)
        if change.radios:
            change.flush.watch_own_entries(connection, for_s=_limit_s(change))
            change.flush.watch_neighbors(for_s=_limit_s(change))
        start(change, connection)
    except Unreachable as error:
        # how far it came, the node itself will tell
        change.last_error = str(error)
    except NodeRefused as refusal:
        unlock(change, connection)
        return Outcome(ctx.name, Result.REFUSED, str(refusal), hint=refusal.hint)
    except NodeError:
        unlock(change, connection)
        raise
    finally:
        connection.close()
    with ctx.step("prove"):
        return poll(change)


def poll(change: ChangeInProgress) -> Outcome:
    """Ask and do what is next until the change has ended one way or the other."""
    run_context = change.ctx.run
    backoff = Backoff(_limit_s(change), run_context.interrupt)
    run_context.interrupt.wait(change.settle_s)
    while not backoff.is_over:
        with change.flush.flush_if_slow():
            connection = connect(change)
        if connection is not None:
            try:
                outcome = _act(change, connection)
            except Unreachable as error:
                change.last_error, outcome = str(error), None
            finally:
                connection.close()
            if change.last is not None:
                run_context.record(change.ctx.name, change.last)
            if outcome is not None:
                _flush_stations(change, outcome)
                return outcome
        else:
            change.flush.unreachable()
        if run_context.interrupt.leaving:
            break
        backoff.pause()
    return _uncertain(change)


def _act(change: ChangeInProgress, connection: SshConnection) -> Outcome | None:
    """Look at the node once and make the next move; an outcome when it was the last."""
    name = change.ctx.name
    match observe_and_decide(change, connection):
        case Action.CONFIRM:
            return Outcome(name, Result.DONE) if confirm(change) else None
        case Action.ABORT:
            abort(change, connection)
        case Action.KEPT:
            unlock(change, connection)
            return Outcome(name, Result.DONE)
        case Action.WENT_BACK:
            unlock(change, connection)
            why = rollback_reason(change.status, change.unmet, change.login_refused, change.connect_error)
            return Outcome(name, Result.ROLLED_BACK, why)
        case Action.FOREIGN:
            status = change.status
            return Outcome(name, Result.REFUSED, f"a change of {status.owner} is {status.state} on it")
        case Action.START | Action.BEGIN as move:
            return _resend(change, connection, move)
        case Action.WAIT:
            pass
    return None


def _resend(change: ChangeInProgress, connection: SshConnection, move: Action) -> Outcome | None:
    """The node has nothing of ours that would begin by itself: send what is missing again, a few times."""
    name = change.ctx.name
    if change.starts >= MAX_STARTS:
        with suppress(NodeError):
            abort(change, connection)
        unlock(change, connection)
        return Outcome(name, Result.FAILED, f"its link breaks before the change is there: {change.last_error}")
    try:
        if move is Action.START:
            arm(change, connection)
        else:
            change.starts += 1
        start(change, connection)
    except NodeRefused as refusal:
        abort(change, connection)
        unlock(change, connection)
        return Outcome(name, Result.REFUSED, str(refusal), hint=refusal.hint)
    return None


def _limit_s(change: ChangeInProgress) -> float:
    """Within this time the change has been confirmed or undone."""
    return change.settle_s + change.extra_s + change.window_s + GRACE_AFTER_WINDOW_S


def _flush_stations(change: ChangeInProgress, outcome: Outcome) -> None:
    if outcome.result in (Result.DONE, Result.ROLLED_BACK):
        change.flush.ended(
            change.last,
            went_back=outcome.result is Result.ROLLED_BACK,
            rebooted=change.last is not None and change.last.boot_id != change.ctx.before.boot_id,
        )


def _uncertain(change: ChangeInProgress) -> Outcome:
    if change.ctx.run.interrupt.leaving:
        why = f"left while its change was under way; it goes back by itself within {change.window_s} s"
    else:
        why = f"not seen since its change began ({change.last_error}); by its own timer it has gone back"
    return Outcome(change.ctx.name, Result.UNCERTAIN, why, hint="`meshctl resume` looks at it again")
