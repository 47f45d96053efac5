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
from meshctl.apply.commit_confirm import follow
from meshctl.apply.context import Job, Work
from meshctl.apply.next_action import Move
from meshctl.device.openwrt import Clocked, measure_uptime
from meshctl.errors import NodeError
from meshctl.fleet import Outcome, Result
from meshctl.nodes.backoff import Pace

# The moment lies this many of the slowest node's round trips ahead, for each turn of the parallel sending, and at
# least LEAD_S, within which a start-stop-daemon and two shells have started on the slowest board.
LEAD_ROUND_TRIPS = 6
LEAD_S = 2.0
# So much of the window is kept for confirming.
CONFIRM_SHARE = 0.25
# The fact beside the outcome of a node that did not make it: what parts it from its mesh now.
LEFT_BEHIND = "left_behind"


@dataclass(slots=True)
class Member:
    """One node of the switch. `failure` is why it cannot take part."""

    job: Job
    attempt: Attempt | None = None
    clock: Clocked | None = None
    failure: Outcome | None = None
    is_scheduled: bool = False
    is_silent: bool = False
    is_proven: bool = False
    is_confirmed: bool = False

    @property
    def name(self) -> str:
        return self.job.name

    @property
    def meshes(self) -> tuple[str, ...]:
        """The meshes whose cell it changes."""
        return self.job.plan.parted_from


@dataclass(slots=True)
class _Switch:
    """The switch under way. `members` are in the order in which they may be lost: farthest first, the entry last."""

    work: Work
    members: Sequence[Member]
    window_s: int
    parallel: int
    entry: str
    pool: ThreadPoolExecutor = field(repr=False)

    def each(self, members: Iterable[Member], act: Callable[[Member], None]) -> None:
        """Do it for all, `parallel` at a time, and wait; a bug is raised."""
        for future in [self.pool.submit(act, member) for member in members]:
            future.result()


def switch(work: Work, jobs: Sequence[Job], *, quorum: float, parallel: int, entry: str) -> dict[str, Outcome]:
    """Carry out the jobs' file changes at one moment. Returns each node's outcome; nothing is raised for a node."""
    members = [Member(job) for job in jobs]
    window_s = max(job.node.confirm_window_s for job in jobs)
    with ThreadPoolExecutor(max_workers=max(1, parallel), thread_name_prefix="switch") as pool:
        run = _Switch(work, members, window_s, max(1, parallel), entry, pool)
        run.each(members, lambda member: _prepare(run, member))
        if any(member.failure for member in members) or work.interrupt.stopping:
            return _call_off(run, "the switch was called off: not every node was ready")
        _schedule(run)
        if not all(member.is_scheduled for member in members):
            return _call_off(run, "the switch was called off: not every node took the moment")
        needed = needed_of(members, quorum)
        told = ", ".join(f"{count} of mesh {mesh}" if len(needed) > 1 else f"{count}" for mesh, count in needed.items())
        work.note(f"{len(members)} nodes change at one moment; {told} of them have to meet again")
        return _settle(run, needed)


def needed_of(members: Iterable[Member], quorum: float) -> dict[str, int]:
    """How many nodes of each changing mesh have to meet again."""
    counts = Counter(mesh for member in members for mesh in member.meshes)
    return {mesh: max(1, math.ceil(quorum * count)) for mesh, count in counts.items()}


def missing_of(proven: Iterable[Member], needed: Mapping[str, int]) -> str:
    """Which meshes are short of nodes; empty when each has as many as it needs."""
    there = Counter(mesh for member in proven for mesh in member.meshes)
    short = {mesh: count for mesh, count in needed.items() if there[mesh] < count}
    return "; ".join(f"{there[mesh]} of mesh {mesh} met again, {count} needed" for mesh, count in short.items())


def _prepare(run: _Switch, member: Member) -> None:
    job = member.job
    try:
        with run.work.access.lease(job.node) as connection:
            member.attempt = attempt_of(job, connection.endpoint, window_s=run.window_s)
            prepare(member.attempt, connection)
            member.clock = measure_uptime(connection)
    except NodeError as error:
        member.failure = Outcome(job.name, Result.FAILED, str(error), hint=error.hint)


def _schedule(run: _Switch) -> None:
    """Tell every node the moment, in its own uptime."""
    slowest_s = max((2 * member.clock.error_s for member in run.members if member.clock is not None), default=0.0)
    turns = math.ceil(len(run.members) / run.parallel)
    moment = time.monotonic() + max(LEAD_S, LEAD_ROUND_TRIPS * slowest_s * turns)

    def tell(member: Member) -> None:
        if member.attempt is None or member.clock is None:
            return
        try:
            with run.work.access.lease(member.job.node) as connection:
                begin(member.attempt, connection, at_uptime_s=member.clock.uptime_at(moment))
            member.is_scheduled = True
        except NodeError as error:
            member.failure = Outcome(member.name, Result.FAILED, str(error), hint=error.hint)

    run.each(run.members, tell)
    if all(member.is_scheduled for member in run.members):
        for member in run.members:
            run.work.access.drop(member.name)
        time.sleep(max(0.0, moment - time.monotonic()))


def _call_off(run: _Switch, reason: str) -> dict[str, Outcome]:
    """Nothing has changed yet, or is about to: drop it everywhere."""

    def drop(member: Member) -> None:
        attempt = member.attempt
        if attempt is None:
            return
        attempt.is_given_up = True
        try:
            with run.work.access.lease(member.job.node) as connection:
                take_back(attempt, connection)
                release(attempt, connection)
        except NodeError as error:
            attempt.trouble = str(error)
        if member.is_scheduled or attempt.trouble:
            # it may have begun before it could be dropped
            outcome = follow(attempt)
            if not outcome.result.is_good:
                member.failure = member.failure or outcome

    run.each(run.members, drop)
    return {member.name: member.failure or Outcome(member.name, Result.PENDING, reason) for member in run.members}


def _settle(run: _Switch, needed: Mapping[str, int]) -> dict[str, Outcome]:
    """Look for everybody in the new cell until all are there or it is time to decide; then decide, once."""
    pace = Pace(run.window_s * (1 - CONFIRM_SHARE), run.work.interrupt)
    run.work.interrupt.wait(max(member.attempt.settle_s for member in run.members if member.attempt is not None))
    while True:
        run.each([member for member in run.members if not member.is_proven], _prove)
        proven = [member for member in run.members if member.is_proven]
        if len(proven) == len(run.members) or pace.is_over or run.work.interrupt.leaving:
            break
        _have_forgotten(run, proven)
        pace.pause()
    has_entry = (
        not run.entry or any(m.name == run.entry for m in proven) or all(m.name != run.entry for m in run.members)
    )
    why = missing_of(proven, needed) if has_entry else "the base did not come back"
    if not why:
        return _keep(run)
    run.work.note(f"{why}; rolling back: {'; '.join(gap_of(member) for member in run.members if not member.is_proven)}")
    return _undo(run, why)


def gap_of(member: Member) -> str:
    """`b01: it has no way to the base`: what kept a member from proving itself when it was last looked for."""
    attempt = member.attempt
    if attempt is None or member.is_silent or not attempt.gaps:
        last_error = "" if attempt is None else attempt.trouble
        return f"{member.name}: it does not answer{f' ({last_error})' if last_error else ''}"
    return f"{member.name}: {', '.join(attempt.gaps)}"


def _have_forgotten(run: _Switch, proven: Sequence[Member]) -> None:
    """Where a cell keeps its channel and BSSID, a node that changed early still hears one that changes late, and may
    come to know its old radio."""
    names = {member.name for member in proven}

    def ask(member: Member) -> None:
        if member.attempt is not None and member.is_silent:
            member.attempt.forgetting.while_silent(names)

    run.each(run.members, ask)


def _prove(member: Member) -> None:
    attempt = member.attempt
    connection = None if attempt is None else reach(attempt)
    member.is_silent = connection is None
    if attempt is None or connection is None:
        return
    try:
        member.is_proven = look(attempt, connection) is Move.CONFIRM
        if attempt.last is not None:
            member.job.work.saw(member.name, attempt.last)
    except NodeError as error:
        attempt.trouble = str(error)
    finally:
        connection.close()


def _keep(run: _Switch) -> dict[str, Outcome]:
    """Confirm those that are there, and those that come late, again and again until the window's end; the others are
    left behind."""

    def keep(member: Member) -> None:
        if not member.is_proven:
            _prove(member)
        if member.attempt is None or not member.is_proven:
            return
        try:
            member.is_confirmed = confirm(member.attempt)
        except NodeError as error:
            member.attempt.trouble = str(error)

    pace = Pace(run.window_s * CONFIRM_SHARE, run.work.interrupt)
    while not pace.is_over:
        run.each([member for member in run.members if not member.is_confirmed], keep)
        if all(member.is_confirmed for member in run.members) or run.work.interrupt.leaving:
            break
        pace.pause()
    return {member.name: _kept_outcome(member) for member in run.members}


def _kept_outcome(member: Member) -> Outcome:
    if member.is_confirmed:
        return Outcome(member.name, Result.DONE)
    gaps = "; ".join(member.attempt.gaps) if member.attempt is not None and member.attempt.gaps else "it was not seen"
    return Outcome(
        member.name,
        Result.UNCERTAIN,
        f"left behind: the others are in the new cell, it goes back to the old one ({gaps})",
        hint="reach it by cable and `meshctl resume`, or take the mesh back to the old cell",
        facts={LEFT_BEHIND: ", ".join(member.job.plan.splits)},
    )


def _undo(run: _Switch, why: str) -> dict[str, Outcome]:
    """Take back whoever can be reached, the farthest first, so that the way to the others lasts; then see them back."""
    gaps = {member.name: gap_of(member) for member in run.members if not member.is_proven}
    for member in run.members:
        if member.attempt is None:
            continue
        member.attempt.is_given_up = True
        connection = reach(member.attempt)
        if connection is None:
            continue
        try:
            take_back(member.attempt, connection)
        except NodeError as error:
            member.attempt.trouble = str(error)
        finally:
            connection.close()
    ended: dict[str, Outcome] = {}

    def see(member: Member) -> None:
        if member.attempt is not None:
            ended[member.name] = follow(member.attempt)

    run.each(run.members, see)
    return {
        member.name: _told(ended.get(member.name), member.name, why, gaps.get(member.name, ""))
        for member in run.members
    }


def _told(outcome: Outcome | None, name: str, why: str, gap: str) -> Outcome:
    if outcome is None:
        return Outcome(name, Result.PENDING, why)
    if outcome.result is Result.ROLLED_BACK:
        return Outcome(
            name, Result.ROLLED_BACK, f"the whole mesh was rolled back: {'; '.join(filter(None, (why, gap)))}"
        )
    return outcome
