"""Change one node's configuration so that every way out but a proof leads back to what it had.

`configure` sends the change over the connection at hand (`_start`: lock, stage, arm, begin) and then, over new
connections to the new address, follows the node's own dead-man's switch (`_follow`) until the change is confirmed or
undone. A cut at any point ends in the same loop: it asks the node what is, and does what is next.
"""

from __future__ import annotations

import re
from contextlib import suppress
from dataclasses import dataclass

from meshctl.apply.change import change_of, new_change_id, new_nonce, services_of
from meshctl.apply.checks import missing
from meshctl.apply.job import Job
from meshctl.apply.settle import Move, applied_age_s, next_move, why_it_went_back
from meshctl.apply.waiting import Pace
from meshctl.device import deadman
from meshctl.device.connection import Endpoint
from meshctl.device.deadman import Change
from meshctl.device.errors import NodeRefused
from meshctl.device.observation import ChangeStatus, Observation
from meshctl.device.observe import observe
from meshctl.device.ssh import SshConnection
from meshctl.errors import NodeError, Unreachable
from meshctl.fleet import Outcome, Result
from meshctl.model import Secret
from meshctl.plan import Cut

# After the window: the node puts its files back, reloads, and its mesh finds it again; a reboot when that fails.
GRACE_AFTER_WINDOW_S = 60.0
# A lock outlives its change by this much, for the moves after it.
LOCK_SLACK_S = 60
# A link that breaks again and again before anything began is given up after so many starts.
STARTS = 3
# reload_config returns before netifd has begun: procd gathers events for 1 s, then interfaces go down and come up.
SETTLE_S = 3.0


@dataclass(slots=True)
class Attempt:
    """A change under way. `gaps` is what was still missing when the node was last seen (`last`)."""

    job: Job
    change: Change
    nonce: Secret
    window_s: int
    old: Endpoint
    new: Endpoint
    starts: int = 0
    gaps: tuple[str, ...] = ()
    last: Observation | None = None
    trouble: str = ""

    @property
    def settle_s(self) -> float:
        """How long the change has to stand before what is seen counts as its effect."""
        return SETTLE_S if self.job.plan.cut > Cut.LOGIN else 0.0


def configure(job: Job, connection: SshConnection) -> Outcome:
    """Carry out the file changes of a node's plan. Owns `connection`; keeps one to the node afterwards if it can.

    Raises NodeError only when nothing was changed on the node.
    """
    attempt = Attempt(
        job,
        change_of(new_change_id(), job.plan, job.wanted, job.before, services_of(job.work.fleet, job.node)),
        new_nonce(),
        job.node.confirm_window_s,
        old=connection.endpoint,
        new=job.work.access.endpoint(job.node),
    )
    try:
        _start(attempt, connection)
    except NodeRefused as refusal:
        return Outcome(job.name, Result.REFUSED, str(refusal), hint=refusal.hint)
    except Unreachable as error:
        # how far it came, the node itself will tell
        attempt.trouble = str(error)
    finally:
        connection.close()
    with job.step("prove"):
        return _follow(attempt)


def _start(attempt: Attempt, connection: SshConnection) -> None:
    """Lock, stage, arm and begin; each verb may be repeated after a cut."""
    job, owner = attempt.job, attempt.job.work.owner
    attempt.starts += 1
    with job.step("stage"):
        _install(job, connection)
        deadman.lock(connection, owner, ttl_s=attempt.window_s + LOCK_SLACK_S)
        deadman.stage(
            connection,
            owner,
            attempt.change,
            rate_bytes_per_s=job.work.rate_bytes_per_s,
            progress=job.progress,
        )
    with job.step("arm"):
        deadman.arm(connection, owner, attempt.change.change_id, nonce=attempt.nonce, window_s=attempt.window_s)
    with job.step("apply"):
        deadman.apply(connection, owner, attempt.change.change_id)


def _install(job: Job, connection: SshConnection) -> None:
    """Put the switch there unless this very version already is."""
    known = job.before.change
    own = re.search(rb"^VERSION=(\S+)", deadman.installed_files()[deadman.PROGRAM][1], re.MULTILINE)
    if known is None or not known.installed or own is None or known.version != own[1].decode():
        deadman.install(connection)


def _follow(attempt: Attempt) -> Outcome:
    """Ask and do what is next until the change has ended one way or the other."""
    work = attempt.job.work
    pace = Pace(attempt.settle_s + attempt.window_s + GRACE_AFTER_WINDOW_S, work.interrupt)
    work.interrupt.wait(attempt.settle_s)
    while not pace.is_over:
        connection = _reach(attempt)
        if connection is not None:
            try:
                outcome = _step(attempt, connection)
            except Unreachable as error:
                attempt.trouble, outcome = str(error), None
            finally:
                connection.close()
            if outcome is not None:
                return outcome
        if work.interrupt.leaving:
            break
        pace.pause()
    return _out_of_sight(attempt)


def _reach(attempt: Attempt) -> SshConnection | None:
    """A new connection to where the node shall be, or else to where it was."""
    job = attempt.job
    for endpoint in dict.fromkeys((attempt.new, attempt.old)):
        try:
            return job.work.access.open(job.node, endpoint=endpoint)
        except NodeError as error:
            attempt.trouble = str(error)
    return None


def _step(attempt: Attempt, connection: SshConnection) -> Outcome | None:
    """Look at the node once and make the next move; an outcome when it was the last."""
    job, change_id = attempt.job, attempt.change.change_id
    seen = observe(connection)
    status = seen.change or ChangeStatus("absent", installed=False)
    attempt.last = seen
    age_s = applied_age_s(status)
    attempt.gaps = missing(job.expected, seen, since_s=age_s)
    if age_s is not None and age_s < attempt.settle_s:
        attempt.gaps = (*attempt.gaps, "it has not settled yet")
    move = next_move(
        change_id,
        status,
        attempt.gaps,
        is_at_new_address=connection.endpoint == attempt.new,
        leaving=job.work.interrupt.leaving,
    )
    match move:
        case Move.CONFIRM:
            return _confirm(attempt)
        case Move.ABORT:
            with suppress(NodeRefused):
                deadman.abort(connection, job.work.owner, change_id)
        case Move.KEPT:
            return _end(attempt, connection, Outcome(job.name, Result.DONE))
        case Move.WENT_BACK:
            why = why_it_went_back(status, attempt.gaps)
            return _end(attempt, connection, Outcome(job.name, Result.ROLLED_BACK, why))
        case Move.FOREIGN:
            return Outcome(job.name, Result.REFUSED, f"a change of {status.owner} is {status.state} on it")
        case Move.START:
            if attempt.starts >= STARTS:
                return Outcome(job.name, Result.FAILED, f"it could not be begun: {attempt.trouble}")
            _start(attempt, connection)
        case Move.WAIT:
            pass
    return None


def _confirm(attempt: Attempt) -> Outcome | None:
    """Confirm over a connection opened only now: whoever gets in after the change proves that it lets people in."""
    job = attempt.job
    connection = job.work.access.open(job.node, endpoint=attempt.new)
    try:
        deadman.confirm(connection, attempt.change.change_id, nonce=attempt.nonce)
        outcome = _end(attempt, connection, Outcome(job.name, Result.DONE))
    except NodeRefused:
        # the window ran out on the way: the next look tells
        connection.close()
        return None
    except BaseException:
        connection.close()
        raise
    job.work.access.keep(job.name, connection)
    return outcome


def _end(attempt: Attempt, connection: SshConnection, outcome: Outcome) -> Outcome:
    """Give the lock back; that it cannot be (it runs out by itself) changes nothing about the outcome."""
    with suppress(NodeError):
        deadman.unlock(connection, attempt.job.work.owner)
    return outcome


def _out_of_sight(attempt: Attempt) -> Outcome:
    job = attempt.job
    if attempt.job.work.interrupt.leaving:
        why = f"left while its change was under way; it goes back by itself within {attempt.window_s} s"
    else:
        why = f"not seen since its change began ({attempt.trouble}); it went back by itself"
    return Outcome(job.name, Result.UNCERTAIN, why, hint="`meshctl resume` looks at it again")
