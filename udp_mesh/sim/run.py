"""Runs a scenario: robots move, send and fail; the observer's view becomes a recording, the totals a summary.

`play(scenario)` -> `RunResult`: the recording's lines, the ledger's totals, latencies per topic, the channel's
counters. Nothing here reads a clock: the same scenario and seed give the same result, to the byte.
"""

from __future__ import annotations

import random
import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from udp_mesh.core.events import (
    Event,
    MessageDelivered,
    MessageExpired,
    MessagePeerLost,
    MessageReceived,
    PeerOffline,
    PeerOnline,
)
from udp_mesh.core.settings import Settings
from udp_mesh.report import recording
from udp_mesh.sim.event_queue import SimEventQueue
from udp_mesh.sim.medium import ChannelCounters
from udp_mesh.sim.mobility import Trajectory
from udp_mesh.sim.scenario import MAX_MESSAGE_BYTES, Flow, Incident, Scenario
from udp_mesh.sim.team import Ledger, Team
from udp_mesh.sim.thin_team import Deliver, ThinMedia
from udp_mesh.sim.turning_back import DECISION_S, DrivenPath

# The send time, at the start of each payload.
_SENT = struct.Struct("<d")
SAMPLE_S = 1.0


@dataclass(slots=True)
class TopicTotal:
    """Messages of one topic that all robots together received; `latencies_s` in order of arrival."""

    messages: int = 0
    bytes: int = 0
    latencies_s: list[float] = field(default_factory=list)


@dataclass(slots=True)
class RunResult:
    """`lines` is the observer's recording; `offered` counts messages sent per topic."""

    scenario: Scenario
    lines: list[str]
    topics: dict[str, TopicTotal]
    offered: dict[str, int]
    ledger: Ledger
    counts: ChannelCounters
    observer_bytes: dict[str, int]
    saved: tuple[int, int] = (0, 0)
    """Messages and bytes that robots did not send because no program wants them, since each last started."""
    thin: dict[str, Any] = field(default_factory=dict)
    """Frames and budgets of thin links, by link."""

    def summary(self) -> dict[str, Any]:
        """The totals as JSON values."""
        return {
            "scenario": self.scenario.name,
            "seed": self.scenario.seed,
            "duration_s": self.scenario.duration_s,
            "accepted": self.ledger.accepted,
            "rejected": self.ledger.rejected.total(),
            "rejected_because": dict(self.ledger.rejected),
            "delivered": self.ledger.total(MessageDelivered),
            "expired": self.ledger.total(MessageExpired),
            "peer_lost": self.ledger.total(MessagePeerLost),
            "ended_twice": len(self.ledger.ended_twice),
            "saved": {"messages": self.saved[0], "bytes": self.saved[1]},
            "observer_bytes": dict(self.observer_bytes),
            "channel": {
                "airtime_share": self.counts.airtime_s / self.scenario.duration_s,
                "transmissions": self.counts.transmissions,
                "bytes": self.counts.bytes,
                "queue_drops": self.counts.queue_drops,
            },
            "thin": self.thin,
            "topics": {
                name: {
                    "offered": self.offered.get(name, 0), "arrived": total.messages, "bytes": total.bytes,
                    "latency_p50_s": _percentile(total.latencies_s, 0.5),
                    "latency_p99_s": _percentile(total.latencies_s, 0.99),
                }
                for name, total in sorted(self.topics.items())
            },
        }  # fmt: skip


def _percentile(values: list[float], share: float) -> float | None:
    return round(sorted(values)[min(len(values) - 1, int(len(values) * share))], 6) if values else None


class _Run:
    def __init__(self, scenario: Scenario) -> None:
        self.scenario = scenario
        self.rng = random.Random(scenario.seed)
        self.driven = {name: DrivenPath(scenario.robots[name], wanted) for name, wanted in scenario.turn_back.items()}
        self.courses: dict[str, Trajectory | DrivenPath] = {**scenario.robots, **scenario.relays, **self.driven}
        self.settings = {
            name: Settings(
                name,
                unkeyed=True,
                topics=scenario.topics,
                window=scenario.window,
                selective=bool(scenario.reads),
                thin=scenario.thin.settings(number),
            )
            for number, name in enumerate(scenario.robots, 1)
        }
        self.random_bytes = self.rng.randbytes(MAX_MESSAGE_BYTES)
        self.lines = [recording.header(scenario.observer, 0.0)]
        self.topics = {topic.name: TopicTotal() for topic in scenario.topics}
        self.offered = {topic.name: 0 for topic in scenario.topics}
        self.observer_bytes = {topic.name: 0 for topic in scenario.topics}
        self.team = Team(
            self.settings, relays=scenario.relays, channel=scenario.channel, loss=self._loss, seed=scenario.seed,
            on_event=self._on_event, thin=self._thin if scenario.thin.radios else None,
        )  # fmt: skip
        for robot in scenario.robots:
            self._subscribe(robot)

    def _subscribe(self, robot: str) -> None:
        if robot in self.scenario.reads:
            self.team.subscribe(robot, self.scenario.reads[robot])

    def _thin(self, event_queue: SimEventQueue, deliver: Deliver, rng: random.Random) -> ThinMedia:
        return ThinMedia(event_queue, self.scenario.thin.radios, self.scenario.robots, deliver, rng)

    def _loss(self, a: str, b: str, now: float) -> float:
        return self.scenario.air.loss(self.courses[a].at(now), self.courses[b].at(now))

    def run(self, progress: Callable[[float], None]) -> None:
        event_queue = self.team.event_queue
        for relay, appear_s in self.scenario.appear_s.items():
            self.team.medium.set_on(relay, False)
            event_queue.at(appear_s, partial(self.team.medium.set_on, relay, True))
        for incident in self.scenario.incidents:
            event_queue.at(incident.at_s, partial(self._apply_incident, incident))
        for flow in self.scenario.flows:
            for source in flow.sources:
                event_queue.at(flow.start_s + self.rng.random() * flow.period_s, partial(self._send, flow, source))
        for robot in self.driven:
            event_queue.at(DECISION_S, partial(self._decide, robot))
        event_queue.at(0.0, partial(self._sample, progress))
        event_queue.run_until(self.scenario.duration_s)

    def _decide(self, robot: str) -> None:
        if self.team.is_running(robot):
            self.driven[robot].decide(self.team.conditions(robot).peers, self.team.event_queue.now)
        self.team.event_queue.after(DECISION_S, partial(self._decide, robot))

    def _apply_incident(self, incident: Incident) -> None:
        match incident.what:
            case "off" | "on":
                self.team.medium.set_on(incident.who, incident.what == "on")
            case "crash":
                self.team.crash(incident.who)
            case "restart":
                self.team.restart(incident.who, self.settings[incident.who])
                self._subscribe(incident.who)
            case _:
                raise ValueError(f"unknown incident {incident.what}")

    def _send(self, flow: Flow, source: str) -> None:
        now = self.team.event_queue.now
        if now >= flow.stop_s:
            return
        if self.team.is_running(source) and source != flow.destination:
            size = flow.size_bytes
            if flow.spread:
                # A lognormal distribution with mean `size_bytes`.
                size = int(size * self.rng.lognormvariate(-(flow.spread**2) / 2, flow.spread))
            size = max(_SENT.size, min(size, MAX_MESSAGE_BYTES))
            start = self.rng.randrange(MAX_MESSAGE_BYTES - size + 1)
            payload = _SENT.pack(now) + self.random_bytes[start : start + size - _SENT.size]
            self.offered[flow.topic] += 1
            self.team.send(source, flow.topic, payload, flow.destination or None)
        self.team.event_queue.after(flow.period_s, partial(self._send, flow, source))

    def _on_event(self, now: float, robot: str, event: Event) -> None:
        match event:
            case MessageReceived(source, topic, _, payload, priority):
                total = self.topics[topic]
                total.messages += 1
                total.bytes += len(payload)
                total.latencies_s.append(now - _SENT.unpack_from(payload)[0])
                if robot == self.scenario.observer:
                    self.observer_bytes[topic] += len(payload)
                    self._record(recording.RecordedArrival(now, robot, source, topic, priority, len(payload)))
            case PeerOnline(peer) | PeerOffline(peer):
                if robot == self.scenario.observer:
                    self._record(recording.Presence(now, robot, peer, isinstance(event, PeerOnline)))
            case _:
                # The ledger records outcomes.
                return

    def _record(
        self, item: recording.RecordedArrival | recording.Presence | recording.Sample | recording.Place
    ) -> None:
        self.lines.append(recording.line(item))

    def _sample(self, progress: Callable[[float], None]) -> None:
        now, observer = self.team.event_queue.now, self.scenario.observer
        progress(now)
        if self.team.is_running(observer):
            for peer in self.team.conditions(observer).peers:
                hops = self.team.medium.hops(peer.name, observer) if peer.name in self.scenario.robots else None
                self._record(
                    recording.Sample(
                        now, observer, peer.name, peer.round_trip_s, peer.loss, peer.received_bits_per_s, hops
                    )
                )
        for name, course in self.courses.items():
            if self.scenario.appear_s.get(name, 0.0) <= now:
                self._record(recording.Place(now, name, *course.at(now)))
        self.team.event_queue.after(SAMPLE_S, partial(self._sample, progress))


def play(scenario: Scenario, progress: Callable[[float], None] = lambda now: None) -> RunResult:
    """Runs to the end; calls `progress` with the virtual time about once per virtual second."""
    run = _Run(scenario)
    run.run(progress)
    saved = [run.team.saved(robot) for robot in scenario.robots]
    return RunResult(
        scenario, run.lines, run.topics, run.offered, run.team.ledger, run.team.medium.counts, run.observer_bytes,
        (sum(messages for messages, _ in saved), sum(size for _, size in saved)),
        {} if run.team.thin is None else run.team.thin.summary(),
    )  # fmt: skip
