"""What must hold in a random team, whatever happens: `python -m tests.udp_mesh.core.promises 0 2000` (seeds).

Messages and changes for some seconds, then everything is repaired. Throughout and afterwards:

- every accepted reliable message has exactly one outcome per destination, soon after the repair;
- `delivered` means received, and with an outbox on disk also confirmed; no run of a node receives a message twice;
- what is ready to be sent has a timer, no less urgent level is served first, and packets have the numbers that
  acknowledgements mean;
- a datagram takes effect once, and not long after it was sent (`taken_once`);
- no timer of a node stays in the past, also where timers come late;
- nothing is left over, and an idle team is quiet: few datagrams, and few wake-ups of each node.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from unittest.mock import patch

from tests.udp_mesh.core.busy_teams import BusyTeam
from tests.udp_mesh.core.hostile_teams import HostileTeam
from tests.udp_mesh.core.random_teams import LOG, Broken, RandomTeam
from tests.udp_mesh.core.taken_once import effects_watched
from udp_mesh.core import transmit
from udp_mesh.core.interfaces import Datagram
from udp_mesh.core.legacy.acks import MAX_BEHIND, WINDOW
from udp_mesh.core.peers.session import Peer
from udp_mesh.core.receiver.reassembly import RELIABLE_TIMEOUT_S
from udp_mesh.core.sender.message import OutgoingMessage
from udp_mesh.core.sender.path import Path
from udp_mesh.core.sender.rate_limit import TokenBucket
from udp_mesh.core.sender.send_memory import COPY_BYTES
from udp_mesh.core.sender.send_state import SendState
from udp_mesh.core.sender.sender import Sender
from udp_mesh.core.sender.sent_packets import Packet, SentPackets
from udp_mesh.core.state import State
from udp_mesh.core.thin.outgoing import LIFE_S

MAX_STEPS_PER_S = 60_000
"""Datagrams, timers and calls of all nodes in a second of virtual time: more is a loop."""
MAX_IDLE_DATAGRAMS_PER_S, MAX_IDLE_WAKEUPS_PER_S = 15, 40
MAX_LEGACY_ACKS_PER_S = WINDOW * MAX_BEHIND + WINDOW * (WINDOW + 1) // 2
"""Each heartbeat of a legacy peer is answered for the fragments expected next, also of messages it just gave up."""
# a message to a peer that only thin links reach may wait there for its whole life
SETTLE_S, LEAST_BYTES_PER_S = LIFE_S + 5.0, 15_000
"""After the repair everything ends within this time, and what waits at that rate: more than one round of offline, lost
and found again, and half of the limited topic's rate."""


def go(team: RandomTeam, seconds: float, until: Callable[[], bool] | None = None) -> bool:
    """Advance in steps, and check after each what holds at any time."""
    end = team.now + seconds
    while team.now < end and not (until is not None and until()):
        began, steps = team.now, 0
        step_end = min(end, team.now + 0.25)
        while team.event_queue.step(step_end):
            steps += 1
            if steps > MAX_STEPS_PER_S:
                raise Broken(f"more than {steps} steps within {team.now - began:.3f} s")
        for name in team.nodes:
            check_node(team, name)
    return until is not None and until()


def check_node(team: RandomTeam, name: str) -> None:
    """What is ready to be sent has a timer, and what waits is counted."""
    state = team.nodes[name]._state
    check_memory(name, state)
    for peer in state.peer_table.peers.values():
        sender = peer.sender
        if sender is None or peer.session is None or not peer.session.path.link or peer in state.ready:
            continue
        if peer.session.path.link not in state.links or sender.state is SendState.UNRESPONSIVE:
            continue
        waiting = any(sender.scheduler.peek(level) for level in range(16) if sender.scheduler.waiting >> level & 1)
        if not (waiting or sender.timed_out or sender.in_flight.outstanding):
            continue
        if not sender.in_flight.outstanding and sender.wake_at == float("inf") and not sender._is_timed_out_due():
            raise Broken(f"{name} has no timer for what waits for {peer.name}: {_shown(peer)}")
        if peer.due_at == float("inf"):
            raise Broken(f"{name} has no timer at all for {peer.name}: {_shown(peer)}")


def check_memory(name: str, state: State) -> None:
    """The memory of what waits for all peers is what is in their queues and outboxes."""
    waiting = [(peer.name, message.accepted) for peer in state.peer_table.peers.values() for message in _pending(peer)]
    waiting += [
        (peer, held.accepted)
        for peer, queues in state.outboxes._held.items()
        for queue in queues.values()
        for held in queue.held
        if not held.dropped
    ]
    memory = state.peer_table.send_memory
    copies = Counter(accepted.message_id for _, accepted in waiting)
    counted = {number: found[0] for number, found in memory._messages.items()}
    if copies != counted:
        raise Broken(f"{name} counts {counted} as waiting, and has {copies}")
    by_peer: Counter[str] = Counter()
    for peer, accepted in waiting:
        by_peer[peer] += memory._messages[accepted.message_id][1] + COPY_BYTES
    if by_peer != memory._by_peer:
        raise Broken(f"{name} counts {memory._by_peer} B as waiting for each peer, and has {dict(by_peer)}")
    if not counted and memory.bytes:
        raise Broken(f"{name} counts {memory.bytes} B although nothing waits")


def _pending(peer: Peer) -> list[OutgoingMessage]:
    return [] if peer.sender is None else list(peer.sender.pending)


def check_finished(team: RandomTeam) -> None:
    """Everything has ended, nothing is left over, and the team is quiet."""
    for name, node in team.nodes.items():
        state = node._state
        if team.disks[name].kept:
            raise Broken(f"{name} has on disk what has ended: {team.disks[name].kept.keys()}")
        left = node.conditions(team.clock(name))
        if left.queued_bytes or left.partial_bytes or state.outboxes.bytes or state.compression_queue.bytes:
            raise Broken(f"{name} still holds {left.queued_bytes} B to send, {left.partial_bytes} B received")
        for bucket in state.rate_limits.values():
            if any(not run.message.ended for run in bucket.parked()):
                raise Broken(f"{name} has parked messages")
        for peer in state.peer_table.peers.values():
            sender = peer.sender
            if sender is None:
                continue
            has_copies = sender.copies.next_at < float("inf")
            if sender.pending or sender.in_flight.outstanding or sender.timed_out or has_copies:
                raise Broken(f"{name} has not finished with {peer.name}: {_shown(peer)}")
            if not peer.online:
                raise Broken(f"{name} does not reach {peer.name}")
    before, wakeups, steps = Counter(team.datagrams), Counter(team.wakeups), 0
    end = team.now + 10.0
    while team.event_queue.step(end):
        steps += 1
    for name, node in team.nodes.items():
        sent = team.datagrams[name] - before[name]
        legacy_peers = sum(peer.legacy for peer in node._state.peer_table.peers.values())
        idle_per_s = MAX_IDLE_DATAGRAMS_PER_S * len(team.homes[name]) + MAX_LEGACY_ACKS_PER_S * legacy_peers
        if sent > 10 * idle_per_s:
            raise Broken(f"{name} sends {sent / 10:.0f} datagrams a second although it has nothing to send")
        if (woken := team.wakeups[name] - wakeups[name]) > 10 * MAX_IDLE_WAKEUPS_PER_S:
            raise Broken(f"{name} wakes {woken / 10:.0f} times a second although there is nothing to do")
    if steps > 10 * 200 * len(team.nodes):
        raise Broken(f"{steps / 10:.0f} steps a second although there is nothing to do")


def _shown(peer: Peer) -> str:
    sender = peer.open_sender()
    return (
        f"{sender.state.name}, {len(sender.pending)} pending, {sender.in_flight.outstanding} in flight, "
        f"{len(sender.timed_out)} timed out, levels {sender.scheduler.waiting:b} waiting, "
        f"{len(sender.unconfirmed)} unconfirmed, next copy at {sender.copies.next_at}"
    )


@contextmanager
def numbers_watched() -> Iterator[None]:
    """Fails when packets in flight are not recorded under the numbers that their datagrams have: then acknowledgements
    mean other packets."""
    add = SentPackets.add

    def watched(sent: SentPackets, number: int, packet: Packet | None) -> None:
        if sent._packets and number != sent.next_number:
            raise Broken(f"packet {number} was recorded as {sent.next_number}")
        add(sent, number, packet)

    with patch.object(SentPackets, "add", watched):
        yield


@contextmanager
def priorities_watched() -> Iterator[None]:
    """Fails when a level is served although a more urgent one of the same peer could have been."""
    send_level = transmit.send_level  # type: ignore[attr-defined]

    def watched(
        sender: Sender,
        path: Path,
        priority: int,
        now: float,
        out: list[Datagram],
        room: int,
        rate_limits: dict[str, TokenBucket],
    ) -> int:
        used = send_level(sender, path, priority, now, out, room, rate_limits)
        waiting = sender.scheduler.waiting & ~sender.packing.waiting
        for level in range(priority) if used else ():
            run = sender.scheduler.peek(level) if waiting >> level & 1 else None
            # A stale message of an urgent level waits like one that is not urgent.
            if run is not None and not (run.stale and priority <= sender.rates.urgent_priority):
                raise Broken(f"level {priority} was served while {run} of level {level} waited")
        return used

    with patch.object(transmit, "send_level", watched):
        yield


def play(seed: int, seconds: float, kind: type[RandomTeam] = RandomTeam) -> RandomTeam:
    """Messages and changes for so long, then none."""
    team = kind(seed)
    with priorities_watched(), numbers_watched(), effects_watched(team):
        dice = team.dice
        go(team, 2.0)
        end = team.now + seconds
        topics = dice.sample(team.topics, dice.randint(2, len(team.topics)))
        if LOG in team.config["a"].topics:
            topics.append(LOG)
        change = dice.choice((0.02, 0.1, 0.2))
        pauses = dice.choice(((0.001, 0.02, 0.2), (0.05, 0.5, 3.0)))
        while team.now < end:
            source = dice.choice(list(team.homes))
            topic = dice.choice(topics)
            target = dice.choice([None, *(name for name in team.homes if name != source)])
            if topic.log is not None or topic.repair:
                target = None
            for _ in range(dice.choice((1, 1, 1, 1, 30))):
                if source in team.nodes:
                    team.publish(source, topic, target)
            if dice.random() < change:
                team.change()
            go(team, dice.choice(pauses))
        go(team, dice.choice((0.0, 10.0)))
        team.repair()
        within_s = SETTLE_S + team.queued_bytes() / LEAST_BYTES_PER_S
        go(team, within_s, until=lambda: not team.unfinished() and not team.queued_bytes())
        if left := team.unfinished():
            raise Broken(f"{len(left)} messages have no outcome after {within_s:.0f} s: {left[:5]}")
        # Until the holders of logs agree.
        go(team, 40.0)
        if team.partial_bytes():
            # A message that was given up: the notice of that was lost.
            go(team, RELIABLE_TIMEOUT_S)
        if isinstance(team, HostileTeam):
            # What comes again so late is not taken.
            go(team, max(0.0, team.replays_until - team.now))
        # Once a minute nodes tell each other what they hold of a log: that may be under way at this very moment.
        go(team, 1.0, until=lambda: not team.queued_bytes())
        check_finished(team)
        return team


def main() -> int:
    """1 if a seed failed."""
    parser = argparse.ArgumentParser(prog="python -m tests.udp_mesh.core.promises", description=__doc__)
    parser.add_argument("first", type=int)
    parser.add_argument("last", type=int)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--hostile", action="store_true", help="networks also replay, damage and filter")
    parser.add_argument("--busy", action="store_true", help="computers are busy; legacy programs and thin links")
    arguments = parser.parse_args()
    kind = HostileTeam if arguments.hostile else BusyTeam if arguments.busy else RandomTeam
    failed = 0
    for seed in range(arguments.first, arguments.last):
        try:
            play(seed, arguments.seconds, kind)
        except Exception as error:  # noqa: BLE001
            failed += 1
            sys.stdout.write(f"seed {seed}: {type(error).__name__}: {str(error)[:600]}\n")
            sys.stdout.flush()
    sys.stdout.write(f"{failed} of {arguments.last - arguments.first} seeds failed\n")
    return min(failed, 1)


if __name__ == "__main__":
    sys.exit(main())
