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
    Attempt,
    attempt_of,
    begin,
    confirm,
    look,
    prepare,
    reach,
    release,
    take_back,
)
from meshctl.apply.context import Job
from meshctl.apply.next_action import Move, why_it_went_back
from meshctl.device.errors import NodeRefused
from meshctl.device.ssh import SshConnection
from meshctl.errors import NodeError, Unreachable
from meshctl.fleet import Outcome, Result
from meshctl.nodes.backoff import Pace

# After the window: the node puts its files back, reloads, and its mesh finds it again; a reboot when that fails.
GRACE_AFTER_WINDOW_S = 60.0
# A link that breaks again and again before anything began is given up after so many starts.
STARTS = 3


def configure(job: Job, connection: SshConnection) -> Outcome:
    """Carry out the file changes of a node's plan. Owns `connection`, and keeps one to the node if all went well.

    Raises NodeError only when nothing was changed on the node.
    """
    # a device that was met on the bench is known by its name from now on
    return carry(attempt_of(job, replace(connection.endpoint, identity=job.name)), connection)


def carry(attempt: Attempt, connection: SshConnection) -> Outcome:
    """Carry a change to its end. Owns `connection`, and keeps one to the node if all went well.

    Raises NodeError only when nothing was changed on the node.
    """
    job = attempt.job
    try:
        prepare(attempt, connection)
        if attempt.radios:
            attempt.forgetting.watch_itself(connection, for_s=_limit_s(attempt))
            attempt.forgetting.beforehand(for_s=_limit_s(attempt))
        begin(attempt, connection)
    except Unreachable as error:
        # how far it came, the node itself will tell
        attempt.trouble = str(error)
    except NodeRefused as refusal:
        release(attempt, connection)
        return Outcome(job.name, Result.REFUSED, str(refusal), hint=refusal.hint)
    except NodeError:
        release(attempt, connection)
        raise
    finally:
        connection.close()
    with job.step("prove"):
        return follow(attempt)


def follow(attempt: Attempt) -> Outcome:
    """Ask and do what is next until the change has ended one way or the other."""
    work = attempt.job.work
    pace = Pace(_limit_s(attempt), work.interrupt)
    work.interrupt.wait(attempt.settle_s)
    while not pace.is_over:
        with attempt.forgetting.beside():
            connection = reach(attempt)
        if connection is not None:
            try:
                outcome = _move(attempt, connection)
            except Unreachable as error:
                attempt.trouble, outcome = str(error), None
            finally:
                connection.close()
            if attempt.last is not None:
                work.saw(attempt.job.name, attempt.last)
            if outcome is not None:
                _have_its_radio_forgotten(attempt, outcome)
                return outcome
        else:
            attempt.forgetting.while_silent()
        if work.interrupt.leaving:
            break
        pace.pause()
    return _out_of_sight(attempt)


def _move(attempt: Attempt, connection: SshConnection) -> Outcome | None:
    """Look at the node once and make the next move; an outcome when it was the last."""
    name = attempt.job.name
    match look(attempt, connection):
        case Move.CONFIRM:
            return Outcome(name, Result.DONE) if confirm(attempt) else None
        case Move.ABORT:
            take_back(attempt, connection)
        case Move.KEPT:
            release(attempt, connection)
            return Outcome(name, Result.DONE)
        case Move.WENT_BACK:
            release(attempt, connection)
            why = why_it_went_back(attempt.status, attempt.gaps, attempt.shut_out, attempt.unreached)
            return Outcome(name, Result.ROLLED_BACK, why)
        case Move.FOREIGN:
            status = attempt.status
            return Outcome(name, Result.REFUSED, f"a change of {status.owner} is {status.state} on it")
        case Move.START | Move.BEGIN as move:
            return _go_on(attempt, connection, move)
        case Move.WAIT:
            pass
    return None


def _go_on(attempt: Attempt, connection: SshConnection, move: Move) -> Outcome | None:
    """The node has nothing of ours that would begin by itself: send what is missing again, a few times."""
    name = attempt.job.name
    if attempt.starts >= STARTS:
        with suppress(NodeError):
            take_back(attempt, connection)
        release(attempt, connection)
        return Outcome(name, Result.FAILED, f"its link breaks before the change is there: {attempt.trouble}")
    try:
        if move is Move.START:
            prepare(attempt, connection)
        else:
            attempt.starts += 1
        begin(attempt, connection)
    except NodeRefused as refusal:
        take_back(attempt, connection)
        release(attempt, connection)
        return Outcome(name, Result.REFUSED, str(refusal), hint=refusal.hint)
    return None


def _limit_s(attempt: Attempt) -> float:
    """Within this time the change has been confirmed or undone."""
    return attempt.settle_s + attempt.extra_s + attempt.window_s + GRACE_AFTER_WINDOW_S


def _have_its_radio_forgotten(attempt: Attempt, outcome: Outcome) -> None:
    if outcome.result in (Result.DONE, Result.ROLLED_BACK):
        attempt.forgetting.when_back(
            attempt.last,
            went_back=outcome.result is Result.ROLLED_BACK,
            rebooted=attempt.last is not None and attempt.last.boot_id != attempt.job.before.boot_id,
        )


def _out_of_sight(attempt: Attempt) -> Outcome:
    if attempt.job.work.interrupt.leaving:
        why = f"left while its change was under way; it goes back by itself within {attempt.window_s} s"
    else:
        why = f"not seen since its change began ({attempt.trouble}); by its own timer it has gone back"
    return Outcome(attempt.job.name, Result.UNCERTAIN, why, hint="`meshctl resume` looks at it again")
