"""Thin links: how long a stop takes to reach a whole team, and what airtime that and presence cost.

    python -m benchmarks.thin_links [--seeds N]

`stop`: a team on one radio, all in range; each receiver loses the given share of frames, and overlapping frames destroy
each other. One node sends a stop of 12 B to all; the time is until the last robot has it. `idle` is the airtime of
presence per node. `mission`: the scenario thin-stop. In virtual time: a seed gives the same figures anywhere.
"""

from __future__ import annotations

import argparse
import random
import statistics
from collections.abc import Callable
from dataclasses import replace
from functools import partial

from udp_mesh.core.endpoint import Endpoint
from udp_mesh.core.events import MessageReceived
from udp_mesh.core.settings import Settings, Topic
from udp_mesh.core.thin.settings import ThinLinkSettings, ThinSettings
from udp_mesh.crypto import Key
from udp_mesh.sim.command import SHIPPED
from udp_mesh.sim.event_queue import SimEventQueue
from udp_mesh.sim.run import play
from udp_mesh.sim.scenario import load
from udp_mesh.sim.thin_medium import ThinMedium

KEYS = (Key(bytes(range(32))),)
LINKS = (
    ThinLinkSettings("RS-485-57600", 46_080.0, 200, 6),
    ThinLinkSettings("SF7-10%", 5_470.0, 120, 0, 0.0125, 0.1),
    ThinLinkSettings("SF7-1%", 5_470.0, 120, 0, 0.0125, 0.01),
)
TEAMS = (4, 10)
LOSSES = (0.0, 0.3)
REST_S = 1500.0
"""Before the stop: budgets are as full as they get."""


class Team:
    """Nodes on one medium."""

    def __init__(self, link: ThinLinkSettings, size: int, loss: float, seed: int) -> None:
        self.queue, self.link, self.rng = SimEventQueue(), link, random.Random(seed)
        self.arrived: dict[str, float] = {}
        self._wakes: dict[str, float] = {}
        names = [f"n{number}" for number in range(size)]
        self.medium = ThinMedium(self.queue, link, names, lambda a, b, now: loss, self._receive, self.rng)
        self.nodes = {}
        for number, name in enumerate(names, 1):
            settings = Settings(
                name, keys=KEYS, topics=(Topic("stop", priority=0, thin=True),), thin=ThinSettings(number, (link,))
            )
            self.nodes[name] = Endpoint(settings, boot_id=self.rng.randbytes(16), rng=self.rng, now=0.0)
            self.pump(name)

    def _receive(self, name: str, frame: bytes) -> None:
        self.nodes[name].receive(frame, self.link.name, ("", 0), self.queue.now)
        self.pump(name)

    def pump(self, name: str) -> None:
        node = self.nodes[name]
        while datagrams := node.datagrams_to_send(self.queue.now):
            for datagram in datagrams:
                self.medium.send(name, datagram.data)
        while (event := node.next_event()) is not None:
            if isinstance(event, MessageReceived):
                self.arrived[name] = self.queue.now
        at = node.next_timer()
        if at is not None and at < self._wakes.get(name, float("inf")):
            self._wakes[name] = at = max(at, self.queue.now + 1e-6)
            self.queue.at(at, partial(self._wake, name, at))

    def _wake(self, name: str, at: float) -> None:
        if self._wakes[name] == at:
            self._wakes[name] = float("inf")
            self.nodes[name].handle_timer(self.queue.now)
            self.pump(name)

    def run(self, seconds: float, until: Callable[[], bool] = lambda: False) -> None:
        end = self.queue.now + seconds
        while not until() and self.queue.step(end):
            pass


def stop(link: ThinLinkSettings, size: int, loss: float, seed: int) -> tuple[float | None, float, float]:
    """(seconds until the last robot has the stop, airtime of the stop on the channel, airtime share of presence)."""
    team = Team(link, size, loss, seed)
    team.run(REST_S / 2)
    before_s = sum(team.medium.counts.airtime_s.values())
    team.run(REST_S / 2)
    idle_s = sum(team.medium.counts.airtime_s.values())
    share = (idle_s - before_s) / (REST_S / 2) / size
    begin = team.queue.now
    team.nodes["n0"].send("stop", bytes(12), now=begin)
    team.pump("n0")
    team.run(120, lambda: len(team.arrived) == size - 1)
    took_s = max(team.arrived.values()) - begin if len(team.arrived) == size - 1 else None
    team.run(120)
    return took_s, sum(team.medium.counts.airtime_s.values()) - idle_s - share * size * (team.queue.now - begin), share


def stop_row(link: ThinLinkSettings, size: int, loss: float, seeds: int) -> str:
    results = [stop(link, size, loss, seed) for seed in range(seeds)]
    times = [took_s for took_s, _, _ in results if took_s is not None]
    airtime_s = statistics.median(result[1] for result in results)
    share = statistics.median(result[2] for result in results)
    median = f"{statistics.median(times):.2f} ({max(times):.1f})" if times else "-"
    return (
        f"| {link.name} | {size} | {loss:.0%} | {len(times)} of {seeds} | {median} | "
        f"{airtime_s:.2f} | {100 * share:.2f} % |"
    )


def mission_row(seed: int) -> str:
    result = play(replace(load(SHIPPED / "thin-stop.yaml"), seed=seed))
    summary = result.summary()
    estop, lora = summary["topics"]["estop"], summary["thin"]["lora"]
    return (
        f"| {seed} | {estop['arrived']} of {2 * estop['offered']} | {estop['latency_p50_s']:.2f} | "
        f"{max(result.topics['estop'].latencies_s):.2f} | {summary['topics']['position']['arrived']} | "
        f"{lora['frames']} | {lora['collided']} | {100 * lora['budget_share']:.0f} % |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.thin_links", description=__doc__)
    parser.add_argument("--seeds", type=int, default=10)
    seeds = parser.parse_args().seeds
    print("| link | nodes | loss | all have it | median (worst), s | airtime of the stop, s | presence, per node |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for link in LINKS:
        for size in TEAMS:
            for loss in LOSSES:
                print(stop_row(link, size, loss, seeds), flush=True)
    print("\n| seed | stops | p50, s | worst, s | positions | frames | collided | of the budget |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    for seed in range(1, 6):
        print(mission_row(seed), flush=True)


if __name__ == "__main__":
    main()
