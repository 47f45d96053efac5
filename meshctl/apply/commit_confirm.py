"""Commit-confirm for one node: a change is confirmed after it has proven itself, or the node rolls it back.

`run_change` arms and starts the change over the existing connection, then polls the node's dead-man's switch over new
connections (`poll`) until the change is confirmed or rolled back. After a cut at any point the same loop continues: it
reads the node's state and takes the next action. A listener receives the events of the change.
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
    is_one_command,
    new_change,
    observe_and_decide,
    send,
    start,
    unlock,
)
from meshctl.apply.context import NodeContext
from meshctl.apply.next_action import Action, flashed_by_others, rollback_reason
from meshctl.device.errors import NodeRefused
from meshctl.device.ssh import SshConnection
from meshctl.errors import NodeError, Unreachable
from meshctl.fleet import Outcome, Result
from meshctl.nodes.backoff import Backoff
from meshctl.nodes.slots import Slot

# After the window the node restores its files, reloads and rejoins its mesh, or reboots where that fails.
GRACE_AFTER_WINDOW_S = 60.0
# Give up on a link that breaks this often before the change starts.
MAX_STARTS = 3


def configure(ctx: NodeContext, connection: SshConnection) -> Outcome:
    """Apply the file changes of a node's plan. Owns `connection`; a confirmed node's connection goes to the pool.

    Raises NodeError only when nothing was changed on the node.
    """
    # a bench device is identified by its node name from now on
    return run_change(new_change(ctx, replace(connection.endpoint, identity=ctx.name)), connection)


def run_change(change: ChangeInProgress, connection: SshConnection) -> Outcome:
    """Run a change to its end. Owns `connection`; a confirmed node's connection goes to the pool.

    Raises NodeError only when nothing was changed on the node.
    """
    ctx = change.ctx
    try:
        with ctx.run.connections.slots.use(ctx.name) as slot:
            if is_one_command(change):
                change.listener.armed(connection, for_s=_limit_s(change))
                send(change, connection, slot)
            else:
                arm(change, connection)
                change.listener.armed(connection, for_s=_limit_s(change))
                start(change, connection)
    except Unreachable as error:
        # the node's status shows how far it got
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
    """Observe and act until the change has ended.

    A connection that was opened after the services had reloaded is kept: another one would prove nothing more.
    """
    run_context = change.ctx.run
    backoff = Backoff(change.starts_in_s + _limit_s(change), run_context.interrupt)
    if not change.is_reloaded:
        run_context.interrupt.wait(change.first_look_s)
    proof: SshConnection | None = None
    try:
        while not backoff.is_over:
            with run_context.connections.slots.use(change.ctx.name) as slot:
                outcome, proof = _observe_once(change, proof, slot)
            if outcome is not None:
                _notify_end(change, outcome)
                return outcome
            if run_context.interrupt.leaving:
                break
            backoff.pause()
    finally:
        if proof is not None:
            proof.close()
    return _uncertain(change)


def _observe_once(
    change: ChangeInProgress, proof: SshConnection | None, slot: Slot
) -> tuple[Outcome | None, SshConnection | None]:
    """The outcome once the change has ended, and the connection to use the next time, if one may be kept."""
    was_reloaded = change.is_reloaded
    if proof is not None and proof.is_open:
        connection: SshConnection | None = proof
    else:
        with change.listener.connecting():
            connection = connect(change)
    if connection is None:
        change.listener.unreachable(is_login_due=change.is_login_due)
        return None, None
    try:
        outcome = _act(change, connection, slot, is_proof=was_reloaded)
    except Unreachable as error:
        change.last_error, outcome = str(error), None
    except BaseException:
        connection.close()
        raise
    if change.last is not None:
        change.ctx.run.record(change.ctx.name, change.last)
    # at its former address it proves nothing, and the new one has to be tried
    if was_reloaded and outcome is None and connection.is_open and connection.endpoint == change.new:
        return None, connection
    if outcome is not None and outcome.result is Result.DONE:
        change.ctx.run.connections.release(change.ctx.name, connection)
    else:
        connection.close()
    return outcome, None


def _act(change: ChangeInProgress, connection: SshConnection, slot: Slot, *, is_proof: bool) -> Outcome | None:
    """Observe the node once and take the next action; the outcome once the change has ended. `is_proof`: the connection
    was opened after the services had reloaded."""
    name = change.ctx.name
    match observe_and_decide(change, connection, is_opened_after_reload=is_proof, slot=slot):
        case Action.CONFIRM:
            # a second login, after the proof, where an effect that nothing showed could refuse it
            proof = connection if is_proof and not change.decides_logins else None
            return Outcome(name, Result.DONE) if confirm(change, proof) else None
        case Action.ABORT:
            abort(change, connection)
        case Action.KEPT:
            unlock(change, connection)
            return Outcome(name, Result.DONE)
        case Action.WENT_BACK:
            unlock(change, connection)
            if change.started_s is None and change.status.last_id != change.id:
                # a power cut has taken what was staged; the node's last reason is that of an earlier change
                return Outcome(name, Result.FAILED, "nothing was changed")
            why = rollback_reason(change.status, change.unmet, change.login_refused, change.connect_error)
            flashed = flashed_by_others(change.ctx.before, change.last)
            return Outcome(name, Result.ROLLED_BACK, f"{flashed}{why}")
        case Action.FOREIGN:
            status = change.status
            return Outcome(name, Result.REFUSED, f"{status.owner} has a change {status.state} on it")
        case Action.START | Action.BEGIN as move:
            return _resend(change, connection, move)
        case Action.WAIT:
            pass
    return None


def _resend(change: ChangeInProgress, connection: SshConnection, move: Action) -> Outcome | None:
    """Arm or start again, a few times: nothing of ours will start by itself on the node."""
    name = change.ctx.name
    if change.starts >= MAX_STARTS:
        with suppress(NodeError):
            abort(change, connection)
        unlock(change, connection)
        return Outcome(name, Result.FAILED, f"its link fails before the change is armed: {change.last_error}")
    try:
        if move is Action.START:
            if change.upload_again is not None:
                change.upload_again(connection)
            arm(change, connection)
        else:
            change.starts += 1
        start(change, connection)
    except NodeRefused as refusal:
        abort(change, connection)
        unlock(change, connection)
        return Outcome(name, Result.REFUSED, str(refusal), hint=refusal.hint)
    return None


def unanswered_text(change: ChangeInProgress, consequence: str) -> str:
    """A reason for a node that may have kept its change: the answer to its confirmation was lost."""
    return f"it did not answer its confirmation ({change.last_error or 'interrupted'}): {consequence}"


def _limit_s(change: ChangeInProgress) -> float:
    """The time within which the change is confirmed or rolled back."""
    return change.first_look_s + change.extra_s + change.window_s + GRACE_AFTER_WINDOW_S


def _notify_end(change: ChangeInProgress, outcome: Outcome) -> None:
    if outcome.result in (Result.DONE, Result.ROLLED_BACK):
        change.listener.ended(
            change.last,
            went_back=outcome.result is Result.ROLLED_BACK,
            rebooted=change.last is not None and change.last.boot_id != change.ctx.before.boot_id,
        )


def _uncertain(change: ChangeInProgress) -> Outcome:
    if change.started_s is None:
        # the node drops what it has staged or armed
        return Outcome(change.ctx.name, Result.FAILED, f"nothing was changed: {change.last_error or 'interrupted'}")
    if change.is_confirm_unanswered:
        why = unanswered_text(change, "it keeps the change if that arrived; otherwise its timer rolls it back")
    elif change.ctx.run.interrupt.leaving:
        why = f"interrupted during its change; it rolls back by itself within {change.window_s} s"
    else:
        error = change.last_error
        why = f"unreachable since its change started ({error}); if it is running, its timer has rolled it back"
    return Outcome(
        change.ctx.name, Result.UNCERTAIN, why, hint="when it answers again, `meshctl status` shows its state"
    )
