"""Look for the participants of a simultaneous change, each at its own pace, until they have proven themselves.

A look takes as long as a login, a reload of a few seconds and an observation; one at a node whose radio restarts
meanwhile, the time after which a silent connection is given up. Neither the looks at the others nor the decision wait
for it.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor, wait

from meshctl.apply.change_in_progress import connect, observe_and_decide
from meshctl.apply.participant import Participant
from meshctl.errors import NodeError
from meshctl.nodes.backoff import MAX_PAUSE_S, Backoff


def prove_until(participants: Sequence[Participant], backoff: Backoff, pool: Executor) -> None:
    """Look for the participants until all are decided, the time of `backoff` is over, or the operator leaves. A look
    that has begun may go on (`Participant.look`)."""
    while True:
        for participant in participants:
            if not participant.is_decided and participant.look is None:
                participant.look = pool.submit(_look, participant, participants)
        wait([each.look for each in participants if each.look is not None], timeout=min(MAX_PAUSE_S, backoff.left_s))
        ended = [each for each in participants if each.look is not None and each.look.done()]
        for participant in ended:
            participant.await_look()
        if all(each.is_decided for each in participants) or backoff.is_over or backoff.interrupt.leaving:
            break
        if ended:
            backoff.pause()
    for participant in participants:
        participant.cancel_look()


def _look(participant: Participant, participants: Sequence[Participant]) -> None:
    prove(participant)
    if participant.is_unreachable and participant.change is not None:
        # where a cell keeps its channel and BSSID, a node that changed early still hears one that changes late, and may
        # create a station entry of the radio before its restart
        participant.change.listener.unreachable({each.name for each in participants if each.is_proven})


def prove(participant: Participant) -> None:
    """Observe a participant once. A connection that was opened after its services had reloaded is kept: another one
    would prove nothing more."""
    change = participant.change
    if change is None:
        return
    was_reloaded = change.is_reloaded
    connection = participant.take_proof() or connect(change)
    participant.is_unreachable = connection is None
    if connection is None:
        return
    try:
        action = observe_and_decide(change, connection, is_opened_after_reload=was_reloaded)
        participant.decide(action)
        if change.last is not None:
            participant.ctx.run.record(participant.name, change.last)
        if was_reloaded and not participant.is_decided and connection.endpoint == change.new:
            participant.proof = connection
    except NodeError as error:
        change.last_error = str(error)
    finally:
        if participant.proof is None:
            connection.close()
