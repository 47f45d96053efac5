"""Change a whole mesh at one moment: all of it, or none.

`switch`: every node is prepared and armed (`_prepare`); each is given the same moment, as its own uptime measured just
before (`_schedule`), so no clock has to be right; then all are looked for in the new cell (`_gather_again`). When all
have proven themselves they are confirmed; at the last moment a quorum of each mesh with the base among it is enough.
Otherwise those that can be reached are taken back, the farthest first, and the others go back by their own timers.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

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
from meshctl.apply.commit_confirm import poll
from meshctl.apply.context import NodeContext, RunContext
from meshctl.apply.next_action import Action
from meshctl.device.openwrt import Clocked, measure_uptime
from meshctl.errors import NodeError
from meshctl.fleet import Outcome, Result
from meshctl.nodes.backoff import Backoff

# The moment lies this many of the slowest node's round trips ahead, for each turn of the parallel sending, and at
# least LEAD_S, within which a start-stop-daemon and two shells have started on the slowest board.
LEAD_ROUND_TRIPS = 6
LEAD_S = 2.0
# So much of the window is kept for confirming.
CONFIRM_SHARE = 0.25
# The fact beside the outcome of a node that did not make it: what parts it from its mesh now.
LEFT_BEHIND = "left_behind"


@dataclass(slots=True)
class Participant:
    """One node of the switch. `failure` is why it cannot take part."""

    ctx: NodeContext
    change: ChangeInProgress | None = None
    clock: Clocked | None = None
    failure: Outcome | None = None
    is_scheduled: bool = False
    is_unreachable: bool = False
    is_proven: bool = False
    is_confirmed: bool = False

    @property
    def name(self) -> str:
        return self.ctx.name

    @property
    def meshes(self) -> tuple[str, ...]:
        """The meshes whose cell it changes."""
        return self.ctx.plan.parted_from


@dataclass(slots=True)
class _MeshCommit:
    """The switch under way. `members` are in the order in which they may be lost: farthest first, the entry last."""

    run: RunContext
    participants: Sequence[Participant]
    window_s: int
    parallel: int
    entry: str
    pool: ThreadPoolExecutor = field(repr=False)

    def each(self, members: Iterable[Participant], act: Callable[[Participant], None]) -> None:
        """Do it for all, `parallel` at a time, and wait; a bug is raised."""
        for future in [self.pool.submit(act, member) for member in members]:
            future.result()


def commit_mesh(
    work: RunContext, jobs: Sequence[NodeContext], *, quorum: float, parallel: int, entry: str
) -> dict[str, Outcome]:
    """Carry out the jobs' file changes at one moment. Returns each node's outcome; nothing is raised for a node."""
    members = [Participant(job) for job in jobs]
    window_s = max(job.node.confirm_window_s for job in jobs)
    with ThreadPoolExecutor(max_workers=max(1, parallel), thread_name_prefix="switch") as pool:
        run = _MeshCommit(work, members, window_s, max(1, parallel), entry, pool)
        run.each(members, lambda member: _arm(run, member))
        if any(member.failure for member in members) or work.interrupt.stopping:
            return _cancel(run, "the switch was called off: not every node was ready")
        _schedule(run)
        if not all(member.is_scheduled for member in members):
            return _cancel(run, "the switch was called off: not every node took the moment")
        needed = quorum_of(members, quorum)
        told = ", ".join(f"{count} of mesh {mesh}" if len(needed) > 1 else f"{count}" for mesh, count in needed.items())
        work.note(f"{len(members)} nodes change at one moment; {told} of them have to meet again")
        return _decide(run, needed)


def quorum_of(members: Iterable[Participant], quorum: float) -> dict[str, int]:
    """How many nodes of each changing mesh have to meet again."""
    counts = Counter(mesh for member in members for mesh in member.meshes)
    return {mesh: max(1, math.ceil(quorum * count)) for mesh, count in counts.items()}


def short_of_quorum(proven: Iterable[Participant], needed: Mapping[str, int]) -> str:
    """Which meshes are short of nodes; empty when each has as many as it needs."""
    there = Counter(mesh for member in proven for mesh in member.meshes)
    short = {mesh: count for mesh, count in needed.items() if there[mesh] < count}
    return "; ".join(f"{there[mesh]} of mesh {mesh} met again, {count} needed" for mesh, count in short.items())


def _arm(run: _MeshCommit, member: Participant) -> None:
    job = member.ctx
    try:
        with run.run.connections.borrow(job.node) as connection:
            member.change = new_change(job, connection.endpoint, window_s=run.window_s)
            arm(member.change, connection)
            member.clock = measure_uptime(connection)
    except NodeError as error:
        member.failure = Outcome(job.name, Result.FAILED, str(error), hint=error.hint)


def _schedule(run: _MeshCommit) -> None:
    """Tell every node the moment, in its own uptime."""
    slowest_s = max((2 * member.clock.error_s for member in run.participants if member.clock is not None), default=0.0)
    turns = math.ceil(len(run.participants) / run.parallel)
    moment = time.monotonic() + max(LEAD_S, LEAD_ROUND_TRIPS * slowest_s * turns)

    def tell(member: Participant) -> None:
        if member.change is None or member.clock is None:
            return
        try:
            with run.run.connections.borrow(member.ctx.node) as connection:
                start(member.change, connection, at_uptime_s=member.clock.uptime_at(moment))
            member.is_scheduled = True
        except NodeError as error:
            member.failure = Outcome(member.name, Result.FAILED, str(error), hint=error.hint)

    run.each(run.participants, tell)
    if all(member.is_scheduled for member in run.participants):
        for member in run.participants:
            run.run.connections.drop(member.name)
        time.sleep(max(0.0, moment - time.monotonic()))


def _cancel(run: _MeshCommit, reason: str) -> dict[str, Outcome]:
    """Nothing has changed yet, or is about to: drop it everywhere."""

    def drop(member: Participant) -> None:
        attempt = member.change
        if attempt is None:
            return
        attempt.is_abandoned = True
        try:
            with run.run.connections.borrow(member.ctx.node) as connection:
                abort(attempt, connection)
                unlock(attempt, connection)
        except NodeError as error:
            attempt.last_error = str(error)
        if member.is_scheduled or attempt.last_error:
            # it may have begun before it could be dropped
            outcome = poll(attempt)
            if not outcome.result.is_good:
                member.failure = member.failure or outcome

    run.each(run.participants, drop)
    return {member.name: member.failure or Outcome(member.name, Result.PENDING, reason) for member in run.participants}


def _decide(run: _MeshCommit, needed: Mapping[str, int]) -> dict[str, Outcome]:
    """Look for everybody in the new cell until all are there or it is time to decide; then decide, once."""
    pace = Backoff(run.window_s * (1 - CONFIRM_SHARE), run.run.interrupt)
    run.run.interrupt.wait(max(member.change.settle_s for member in run.participants if member.change is not None))
    while True:
        run.each([member for member in run.participants if not member.is_proven], _prove)
        proven = [member for member in run.participants if member.is_proven]
        if len(proven) == len(run.participants) or pace.is_over or run.run.interrupt.leaving:
            break
        _flush_unreachable(run, proven)
        pace.pause()
    has_entry = (
        not run.entry or any(m.name == run.entry for m in proven) or all(m.name != run.entry for m in run.participants)
    )
    why = short_of_quorum(proven, needed) if has_entry else "the base did not come back"
    if not why:
        return _confirm_all(run)
    run.run.note(
        f"{why}; rolling back: {'; '.join(gap_of(member) for member in run.participants if not member.is_proven)}"
    )
    return _roll_back(run, why)


def gap_of(member: Participant) -> str:
    """`b01: it has no way to the base`: what kept a member from proving itself when it was last looked for."""
    attempt = member.change
    if attempt is None or member.is_unreachable or not attempt.unmet:
        last_error = "" if attempt is None else attempt.last_error
        return f"{member.name}: it does not answer{f' ({last_error})' if last_error else ''}"
    return f"{member.name}: {', '.join(attempt.unmet)}"


def _flush_unreachable(run: _MeshCommit, proven: Sequence[Participant]) -> None:
    """Where a cell keeps its channel and BSSID, a node that changed early still hears one that changes late, and may
    come to know its old radio."""
    names = {member.name for member in proven}

    def ask(member: Participant) -> None:
        if member.change is not None and member.is_unreachable:
            member.change.flush.unreachable(names)

    run.each(run.participants, ask)


def _prove(member: Participant) -> None:
    attempt = member.change
    connection = None if attempt is None else connect(attempt)
    member.is_unreachable = connection is None
    if attempt is None or connection is None:
        return
    try:
        member.is_proven = observe_and_decide(attempt, connection) is Action.CONFIRM
        if attempt.last is not None:
            member.ctx.run.record(member.name, attempt.last)
    except NodeError as error:
        attempt.last_error = str(error)
    finally:
        connection.close()


def _confirm_all(run: _MeshCommit) -> dict[str, Outcome]:
    """Confirm those that are there, and those that come late, again and again until the window's end; the others are
    left behind."""

    def keep(member: Participant) -> None:
        if not member.is_proven:
            _prove(member)
        if member.change is None or not member.is_proven:
            return
        try:
            member.is_confirmed = confirm(member.change)
        except NodeError as error:
            member.change.last_error = str(error)

    pace = Backoff(run.window_s * CONFIRM_SHARE, run.run.interrupt)
    while not pace.is_over:
        run.each([member for member in run.participants if not member.is_confirmed], keep)
        if all(member.is_confirmed for member in run.participants) or run.run.interrupt.leaving:
            break
        pace.pause()
    return {member.name: _confirmed_outcome(member) for member in run.participants}


def _confirmed_outcome(member: Participant) -> Outcome:
    if member.is_confirmed:
        return Outcome(member.name, Result.DONE)
    gaps = "; ".join(member.change.unmet) if member.change is not None and member.change.unmet else "it was not seen"
    return Outcome(
        member.name,
        Result.UNCERTAIN,
        f"left behind: the others are in the new cell, it goes back to the old one ({gaps})",
        hint="reach it by cable and `meshctl resume`, or take the mesh back to the old cell",
        facts={LEFT_BEHIND: ", ".join(member.ctx.plan.splits)},
    )


def _roll_back(run: _MeshCommit, why: str) -> dict[str, Outcome]:
    """Take back whoever can be reached, the farthest first, so that the way to the others lasts; then see them back."""
    gaps = {member.name: gap_of(member) for member in run.participants if not member.is_proven}
    for member in run.participants:
        if member.change is None:
            continue
        member.change.is_abandoned = True
        connection = connect(member.change)
        if connection is None:
            continue
        try:
            abort(member.change, connection)
        except NodeError as error:
            member.change.last_error = str(error)
        finally:
            connection.close()
    ended: dict[str, Outcome] = {}

    def see(member: Participant) -> None:
        if member.change is not None:
            ended[member.name] = poll(member.change)

    run.each(run.participants, see)
    return {
        member.name: _rolled_back_outcome(ended.get(member.name), member.name, why, gaps.get(member.name, ""))
        for member in run.participants
    }


def _rolled_back_outcome(outcome: Outcome | None, name: str, why: str, gap: str) -> Outcome:
    if outcome is None:
        return Outcome(name, Result.PENDING, why)
    if outcome.result is Result.ROLLED_BACK:
        return Outcome(
            name, Result.ROLLED_BACK, f"the whole mesh was rolled back: {'; '.join(filter(None, (why, gap)))}"
        )
    return outcome
