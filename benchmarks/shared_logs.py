"""Ten robots at random: artifacts to the base by a shared log, by direct delivery alone, and by flooding.

    python -m benchmarks.shared_logs [--seeds N] [--seconds S] [--ways WAY,...] [--results FILE] [--fill]

Robots walk between random points of a square and rarely meet; the base stays in a corner. Each robot publishes an
artifact now and then; the last part of a run has no new ones, so that what can still arrive does. `direct`: an
outbox for the base. `flooding`: each robot sends what it hears for the first time to all others, with an outbox for
each. Prints one JSON line per run and a table; all in virtual time, so that a seed gives the same figures anywhere.
With `--results`, runs are appended to a file, and those that it contains are not repeated; `--fill` writes the table
to docs/benchmarks.md. Flooding fills the channel: half a second of processor time per simulated second, or more.
"""

from __future__ import annotations

import argparse
import json
import random
import statistics
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks.page import fill
from udp_mesh.core.events import Event, MessageReceived
from udp_mesh.core.settings import Log, Outbox, Settings, Topic
from udp_mesh.sim.medium import RadioChannel
from udp_mesh.sim.mobility import PathLoss, Trajectory, stationary, trajectory
from udp_mesh.sim.team import Team

WAYS = ("log", "direct", "flooding")
ROBOTS = 10
SIDE_M = 400.0
SPEED_M_S = 1.5
RANGE = PathLoss(good_m=60.0, range_m=120.0)
PERIOD_S = 60.0
ARTIFACT_BYTES = 50_000
QUIET_SHARE = 1 / 3
_HEAD = 8
_NUMBER = 4


def topic(way: str) -> Topic:
    """The artifacts' topic."""
    match way:
        case "log":
            return Topic("artifact", priority=4, log=Log(readers=("base",)))
        case "direct":
            return Topic("artifact", priority=4, destinations=("base",), outbox=Outbox.ALL, outbox_bytes=1 << 30)
        case _:
            return Topic("artifact", priority=4, outbox=Outbox.ALL, outbox_bytes=1 << 30)


def walk(rng: random.Random, seconds: float) -> Trajectory:
    """Random waypoints in the square."""
    at = (rng.uniform(0, SIDE_M), rng.uniform(0, SIDE_M))
    time_s, points = 0.0, [(0.0, at)]
    while time_s < seconds:
        to = (rng.uniform(0, SIDE_M), rng.uniform(0, SIDE_M))
        time_s += max(1.0, ((to[0] - at[0]) ** 2 + (to[1] - at[1]) ** 2) ** 0.5 / SPEED_M_S)
        points.append((time_s, to))
        at = to
    return trajectory(points)


def play(way: str, seed: int, seconds: float) -> dict[str, Any]:
    """One run."""
    rng = random.Random(seed)
    names = [f"robot{number}" for number in range(ROBOTS)]
    places = {"base": stationary((0.0, 0.0)), **{name: walk(rng, seconds) for name in names}}
    settings = {name: Settings(name, unkeyed=True, topics=(topic(way),)) for name in places}
    published: dict[bytes, float] = {}
    delays: dict[bytes, float] = {}
    twice = 0
    seen: dict[str, set[bytes]] = {name: set() for name in places}
    later: list[Callable[[], object]] = []

    def on_event(now: float, robot: str, event: Event) -> None:
        nonlocal twice
        if not isinstance(event, MessageReceived):
            return
        mark = bytes(event.payload[:_HEAD])
        if robot == "base":
            if mark in delays and way != "flooding":
                twice += 1
            delays.setdefault(mark, now - published[mark])
        elif way == "flooding" and mark not in seen[robot]:
            later.append(lambda: team.send(robot, "artifact", event.payload))
        seen[robot].add(mark)

    team = Team(
        settings,
        channel=RadioChannel(),
        loss=lambda a, b, now: RANGE.loss(places[a].at(now), places[b].at(now)),
        seed=seed,
        on_event=on_event,
    )
    next_at = {name: rng.uniform(0, PERIOD_S) for name in names}
    while team.event_queue.now < seconds:
        now = team.event_queue.now
        team.event_queue.run_until(min(seconds, now + 0.5))
        while later:
            later.pop()()
        for name, at in next_at.items():
            if at <= team.event_queue.now < seconds * (1 - QUIET_SHARE):
                next_at[name] = at + PERIOD_S
                mark = names.index(name).to_bytes(_NUMBER, "big") + round(at * 1000).to_bytes(_NUMBER, "big")
                published[mark] = team.event_queue.now
                seen[name].add(mark)
                team.send(name, "artifact", mark + rng.randbytes(ARTIFACT_BYTES - _HEAD))
    counts = team.medium.counts
    return {
        "way": way,
        "seed": seed,
        "seconds": seconds,
        "published": len(published),
        "arrived": len(delays),
        "twice": twice,
        "delay_p50_s": round(statistics.median(delays.values()), 1) if delays else None,
        "airtime_s": round(counts.airtime_s, 1),
        "bytes": counts.bytes,
    }


def read_results(path: Path | None) -> list[dict[str, Any]]:
    """The runs in a file of JSON lines; none if it does not exist."""
    if path is None or not path.exists():
        return []
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--seconds", type=float, default=1800.0)
    parser.add_argument("--ways", default=",".join(WAYS), help="comma-separated")
    parser.add_argument("--results", type=Path, help="JSON lines")
    parser.add_argument("--fill", action="store_true", help="write the table to docs/benchmarks.md")
    arguments = parser.parse_args()
    ways = arguments.ways.split(",")
    runs = read_results(arguments.results)
    done = {(run["way"], run["seed"], run["seconds"]) for run in runs}
    for seed in range(1, arguments.seeds + 1):
        for way in ways:
            if (way, seed, arguments.seconds) in done:
                continue
            run = play(way, seed, arguments.seconds)
            runs.append(run)
            print(json.dumps(run), flush=True)
            if arguments.results is not None:
                with arguments.results.open("a", encoding="utf-8") as file:
                    file.write(f"{json.dumps(run)}\n")
    lines = table(runs, ways, arguments.seconds, arguments.seeds)
    print(*lines, sep="\n")
    if arguments.fill:
        fill("shared logs", "\n".join(lines))


def table(runs: list[dict[str, Any]], ways: list[str], seconds: float, seeds: int) -> list[str]:
    """The runs of this length with the first seeds, as Markdown."""
    lines = [
        "| way | seeds | arrived | twice | median delay (s) | airtime per artifact published (ms) |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for way in ways:
        mine = [run for run in runs if (run["way"], run["seconds"]) == (way, seconds) and run["seed"] <= seeds]
        arrived, published = sum(run["arrived"] for run in mine), sum(run["published"] for run in mine)
        delays_s = [run["delay_p50_s"] for run in mine if run["delay_p50_s"] is not None]
        delay = f"{statistics.median(delays_s):.0f}" if delays_s else "-"
        airtime_ms = 1000 * sum(run["airtime_s"] for run in mine) / published
        # A program that floods gets an artifact from many; it tells them apart itself.
        twice = "-" if way == "flooding" else sum(run["twice"] for run in mine)
        lines.append(
            f"| {way} | {len(mine)} | {arrived / published:.1%} of {published} | {twice} | {delay} | {airtime_ms:.0f} |"
        )
    return lines


if __name__ == "__main__":
    main()
