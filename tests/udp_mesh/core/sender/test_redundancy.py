"""Small urgent fragments are sent again: soon on a lossy path, and whenever their acknowledgment is overdue."""

from __future__ import annotations

import pytest

from tests.udp_mesh.core.test_links import Run
from udp_mesh.core.events import MessageId
from udp_mesh.core.sender.message import AcceptedMessage, OutgoingMessage, TopicChannel
from udp_mesh.core.sender.redundancy import EARLY_COPIES, MAX_OVERDUE_COPIES, RedundantCopies
from udp_mesh.core.sender.sent_packets import SendSnapshot
from udp_mesh.core.settings import Topic

GAP_S, OVERDUE_S = 0.003, 0.030
EARLY_S = [GAP_S, *(gaps * GAP_S for _, gaps in EARLY_COPIES)]


def fragment(*, reliable: bool = True) -> OutgoingMessage:
    topic = Topic("stop", priority=0, reliable=reliable)
    accepted = AcceptedMessage(MessageId(1), TopicChannel(0, topic, topic.name, ""), b"x", b"x", 0, 0.0, None)
    message = OutgoingMessage(accepted, 0, reliable=reliable)
    message.begin(0, 1400, 1400)
    return message


def sendings(
    message: OutgoingMessage,
    *,
    twice: bool,
    loss: float,
    answered_at: float = float("inf"),
    overdue_s: float = OVERDUE_S,
) -> list[float]:
    """When copies of a fragment sent at 0 are due."""
    copies = RedundantCopies()
    copies.schedule(message, 0, 0.0, gap_s=GAP_S, twice=twice, loss=loss, urgent_timeout_s=overdue_s)
    times = []
    while copies.next_at < float("inf"):
        at = copies.next_at
        if at >= answered_at:
            message.arrived[0] = 1
        times += [at for _ in copies.pop_due(at, overdue_s)]
    return times


def test_higher_loss_sends_more_early_copies_of_an_urgent_fragment() -> None:
    early = [
        sum(at < OVERDUE_S for at in sendings(fragment(), twice=twice, loss=loss))
        for twice, loss in ((False, 0.0), (True, 0.05), (True, 0.1), (True, 0.2))
    ]
    assert early == [0, 1, 2, 3]
    assert sendings(fragment(), twice=False, loss=0.0) == []
    assert sendings(fragment(), twice=True, loss=0.2)[:3] == pytest.approx(EARLY_S)


def test_no_early_copy_is_sent_shortly_before_the_answer_is_overdue() -> None:
    times = sendings(fragment(), twice=True, loss=0.2, overdue_s=0.025)
    assert times[:3] == pytest.approx([*EARLY_S[:2], 0.025])
    # Nothing is awaited of a best-effort message.
    message = fragment(reliable=False)
    assert sendings(message, twice=True, loss=0.2, overdue_s=0.025) == pytest.approx(EARLY_S)


def test_an_overdue_acknowledgement_triggers_a_bounded_number_of_copies() -> None:
    later = [at for at in sendings(fragment(), twice=True, loss=0.05) if at > GAP_S]
    assert later == pytest.approx([n * OVERDUE_S for n in range(1, MAX_OVERDUE_COPIES + 1)])


def test_an_acknowledgement_stops_further_copies() -> None:
    assert sendings(fragment(), twice=True, loss=0.2, answered_at=0.02) == pytest.approx(EARLY_S)


def test_best_effort_fragments_are_only_copied_early() -> None:
    message = fragment(reliable=False)
    message.ended = True
    assert sendings(message, twice=True, loss=0.2) == pytest.approx(EARLY_S)


def test_urgent_packets_are_not_used_as_rtt_samples_while_bulk_is_sent() -> None:
    run = Run(urgent=True)
    run.start()
    run.world.run(3.0)
    sender = run.world.nodes["a"]._state.peer_table.peers["b"].open_sender()
    smoothed, now = sender.rtt.smoothed_rtt, run.world.now
    assert not sender.round_trips.sample(sent(now - 0.001, urgent=True), 0.0, now)
    assert sender.rtt.smoothed_rtt == smoothed
    assert sender.round_trips.sample(sent(now - 0.030, urgent=False), 0.0, now)
    # With no other traffic, urgent packets are all there is to measure.
    assert sender.round_trips.sample(sent(now + 9.999, urgent=True), 0.0, now + 10.0)


def sent(at: float, *, urgent: bool) -> SendSnapshot:
    return SendSnapshot(at, 0, 0.0, 0.0, app_limited=False, urgent=urgent)
