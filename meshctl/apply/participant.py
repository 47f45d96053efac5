"""A node of a simultaneous change: how far it got, which quorum it counts for, and why it failed."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass

from meshctl.apply.change_in_progress import ChangeInProgress
from meshctl.apply.commit_confirm import unanswered_text
from meshctl.apply.context import NodeContext
from meshctl.apply.next_action import Action, reason_text
from meshctl.device.openwrt import UptimeSample
from meshctl.device.ssh import SshConnection
from meshctl.fleet import Outcome, Result

# The scheduled moment is this many round trips of the slowest node ahead, or this many times the time that the slowest
# took to be armed, for each batch of parallel commands, and at least LEAD_S: the slowest board needs that to start a
# start-stop-daemon and two shells.
LEAD_ROUND_TRIPS = 6
LEAD_ARMS = 3
LEAD_S = 2.0
# The fact in the outcome of a node left in the old cell: what differs between its cell and the mesh's.
LEFT_BEHIND = "left_behind"
# Each of the others has its own reason in its own outcome.
MAX_NAMED = 3


@dataclass(slots=True)
class Participant:
    """One node of the mesh change. `failure` is why it cannot take part."""

    ctx: NodeContext
    # not because the cell changes: the operator wants all nodes to change simultaneously
    is_together: bool = False
    change: ChangeInProgress | None = None
    clock: UptimeSample | None = None
    failure: Outcome | None = None
    is_scheduled: bool = False
    is_unreachable: bool = False
    is_proven: bool = False
    # it has rolled back, or its reload has failed
    has_failed: bool = False
    is_confirmed: bool = False
    # a connection that was opened after its services had reloaded, kept until the node has proven itself
    proof: SshConnection | None = None
    # the look at it that is queued, or in progress
    look: Future[None] | None = None

    @property
    def name(self) -> str:
        return self.ctx.name

    @property
    def meshes(self) -> tuple[str, ...]:
        """The meshes whose quorum this node counts for: those whose cell it changes, or all of its own."""
        return self.ctx.plan.meshes if self.is_together else self.ctx.plan.parted_from

    @property
    def is_decided(self) -> bool:
        return self.is_proven or self.has_failed

    @property
    def leaves_cell(self) -> bool:
        return bool(self.ctx.plan.splits)

    def await_look(self) -> None:
        """Wait for the end of the look in progress. Raises what it raised."""
        if self.look is not None:
            self.look.result()
            self.look = None

    def cancel_look(self) -> None:
        """Drop the look if it has not begun."""
        if self.look is not None and self.look.cancel():
            self.look = None

    def take_proof(self) -> SshConnection | None:
        """The kept connection, if it is still open."""
        proof, self.proof = self.proof, None
        return proof if proof is not None and proof.is_open else None

    def awaits_confirm(self, *, is_window_over: bool) -> bool:
        """Whether it may still be confirmed: after the window only if the answer to its confirmation may be lost."""
        is_unanswered = self.change is not None and self.change.is_confirm_unanswered
        return not (self.is_confirmed or self.has_failed) and (is_unanswered or not is_window_over)

    def decide(self, action: Action) -> None:
        """Take over what a look at the node showed. One in the new cell may still prove itself although its reload
        failed: given up too early, it would be left behind and need a cable."""
        self.is_proven = action is Action.CONFIRM
        gives_up = action is Action.ABORT and not self.leaves_cell
        self.has_failed = gives_up or action is Action.WENT_BACK


def canceled_because(participants: Iterable[Participant], step: str, what: str = "the mesh change") -> str:
    """Why no node changes: the participants that could not be armed or scheduled, each with its reason."""
    failed = [
        f"{participant.name} could not be {step}: {participant.failure.reason}"
        for participant in participants
        if participant.failure is not None
    ]
    if not failed:
        return f"{what} was canceled: interrupted"
    more = f"; and {len(failed) - MAX_NAMED} more" if len(failed) > MAX_NAMED else ""
    return f"{what} was canceled: {'; '.join(failed[:MAX_NAMED])}{more}"


def lead_s(participants: Iterable[Participant], turns: int) -> float:
    """How far ahead the moment is, so that every node has its start in time; all are reached in so many batches."""
    members = tuple(participants)
    round_trip_s = max((2 * each.clock.error_s for each in members if each.clock is not None), default=0.0)
    arm_s = max((each.change.armed_in_s for each in members if each.change is not None), default=0.0)
    return max(LEAD_S, turns * max(LEAD_ROUND_TRIPS * round_trip_s, LEAD_ARMS * arm_s))


def quorum_of(participants: Iterable[Participant], quorum: float) -> dict[str, int]:
    """How many nodes of each changing mesh must prove themselves."""
    counts = Counter(mesh for participant in participants for mesh in participant.meshes)
    return {mesh: max(1, math.ceil(quorum * count)) for mesh, count in counts.items()}


def short_of_quorum(proven: Iterable[Participant], needed: Mapping[str, int], success: str = "rejoined") -> str:
    """Which meshes are below their quorum; empty when none is."""
    there = Counter(mesh for participant in proven for mesh in participant.meshes)
    short = {mesh: count for mesh, count in needed.items() if there[mesh] < count}
    return "; ".join(f"{there[mesh]} of mesh {mesh} {success}, {count} required" for mesh, count in short.items())


def entries_lost(lost: Sequence[Participant], entries: Sequence[str]) -> str:
    """`the base did not come back`: why a change fails in which entry nodes have not proven themselves."""
    named = "the base" if len(entries) == 1 else ", ".join(participant.name for participant in lost)
    if any(participant.is_unreachable for participant in lost):
        return f"{named} did not come back"
    if any(cause_of(participant) for participant in lost):
        return f"{named} rolled back"
    return f"{named} did not pass {'its' if len(lost) == 1 else 'their'} checks"


def unmet_of(participant: Participant) -> str:
    """`b01: it has no route to the base`: why a participant had not proven itself in its latest observation."""
    change = participant.change
    if change is None or participant.is_unreachable or not change.unmet:
        last_error = "" if change is None else change.last_error
        if not (participant.is_unreachable or last_error):
            # the first look at it is still in progress
            return f"{participant.name}: it was not observed"
        return f"{participant.name}: it does not answer{f' ({last_error})' if last_error else ''}"
    return f"{participant.name}: {', '.join(change.unmet)}"


def cause_of(participant: Participant) -> str:
    """`b01: its power was cut, ...`: why a participant rolled back by itself; empty if it was only made to, or was not
    confirmed in time, as all of them."""
    change = participant.change
    if change is None or change.status.last_id != change.id or change.status.last_outcome != "restored":
        return ""
    is_common = change.status.last_reason.partition("+")[0] in ("abort", "timeout")
    return "" if is_common else f"{participant.name}: {reason_text(change.status.last_reason)}"


def rolled_back_outcome(outcome: Outcome | None, name: str, reason: str, gap: str) -> Outcome:
    """The outcome of a participant after all were rolled back for `reason`; `gap` is its own."""
    if outcome is None:
        return Outcome(name, Result.PENDING, reason)
    if outcome.result is Result.ROLLED_BACK:
        return Outcome(name, Result.ROLLED_BACK, "; ".join(filter(None, (reason, gap))))
    return outcome


def unconfirmed_outcome(participant: Participant) -> Outcome:
    """The outcome of a participant that was not confirmed with the others and left its cell with them."""
    change = participant.change
    if change is not None and change.is_confirm_unanswered:
        why = unanswered_text(change, "it is in the new cell if that arrived; otherwise it rolls back to the old one")
        return Outcome(participant.name, Result.UNCERTAIN, why, hint="run `meshctl resume`, by cable if it is away")
    unmet = "; ".join(change.unmet) if change is not None and change.unmet else "it was not observed"
    return Outcome(
        participant.name,
        Result.UNCERTAIN,
        f"left behind: the others are in the new cell, it rolls back to the old one ({unmet})",
        # it does not answer the plan of the change back, which brings it into the mesh again
        hint="connect it by cable and run `meshctl resume`, or change the mesh back to the old cell with "
        f"`--leave-behind {participant.name}`",
        facts={LEFT_BEHIND: ", ".join(participant.ctx.plan.splits)},
    )
