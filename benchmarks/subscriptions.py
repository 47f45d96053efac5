"""Subscriptions: how busy a team's channel is if everything is sent, what is read, and no faster than it is read.

    python -m benchmarks.subscriptions [--seeds N] [--fill]

Four robots and a base share one radio channel of 12 Mbit/s. Each robot publishes to all: video frames of 10 kB five
times a second, a map of 20 kB every two seconds, telemetry of 400 B ten times a second. `everything`: subscriptions
are off. `what is read`: only the base reads video and maps; robots
read each other's telemetry. `at the rate that is shown`: the base displays one frame a second. In virtual time: a seed
gives the same figures anywhere.
"""

from __future__ import annotations

import argparse
import statistics
from dataclasses import replace

from benchmarks.page import fill
from benchmarks.tables import row
from udp_mesh.core.settings import Topic
from udp_mesh.core.subscriptions.messages import Bounds, Subscription
from udp_mesh.sim.medium import RadioChannel
from udp_mesh.sim.mobility import PathLoss, stationary
from udp_mesh.sim.reads import Reads
from udp_mesh.sim.run import play
from udp_mesh.sim.scenario import Flow, Scenario

SECONDS = 60.0
START_S = 8.0
"""When traffic begins: nodes announce what they read once they have run for some seconds."""
ROBOTS = ("ugv1", "ugv2", "uav1", "uav2")
VIDEO, MAP, TELEMETRY = "video", "map", "telemetry"
_OF_ROBOTS: Reads = dict.fromkeys(ROBOTS, (Subscription(TELEMETRY),))
WAYS: dict[str, Reads] = {
    "everything": {},
    "what is read": {**_OF_ROBOTS, "base": tuple(map(Subscription, (VIDEO, MAP, TELEMETRY)))},
    "at the rate that is shown": {
        **_OF_ROBOTS,
        "base": (Subscription(VIDEO, Bounds(rate_hz=1.0)), Subscription(MAP), Subscription(TELEMETRY)),
    },
}


def scenario(seed: int) -> Scenario:
    places = {name: stationary((10.0 * number, 0.0)) for number, name in enumerate(("base", *ROBOTS))}
    return Scenario(
        name="subscriptions",
        seed=seed,
        duration_s=SECONDS,
        robots=places,
        relays={},
        appear_s={},
        channel=RadioChannel(rate=12e6),
        air=PathLoss(),
        topics=(
            Topic(TELEMETRY, priority=6, reliable=False, keep_last=1, deadline_s=1.0),
            Topic(VIDEO, priority=10, reliable=False, keep_last=1, deadline_s=1.0),
            Topic(MAP, priority=8, keep_last=1),
        ),
        flows=(
            Flow(TELEMETRY, ROBOTS, "", 0.1, 400, start_s=START_S),
            Flow(VIDEO, ROBOTS, "", 0.2, 10_000, start_s=START_S),
            Flow(MAP, ROBOTS, "", 2.0, 20_000, start_s=START_S),
        ),
        incidents=(),
        observer="base",
        window="adaptive",
    )


def measure(seed: int, reads: Reads) -> dict[str, float]:
    """Shares of 1: of the channel's time, of video frames that reached the base; and p99 latencies in seconds."""
    result = play(replace(scenario(seed), reads=reads))
    telemetry = sorted(result.topics[TELEMETRY].latencies_s)
    return {
        "busy": result.counts.airtime_s / (SECONDS - START_S),
        "video": result.observer_bytes[VIDEO] / (10_000 * result.offered[VIDEO]),
        "map": result.observer_bytes[MAP] / (20_000 * result.offered[MAP]),
        "telemetry_p99_s": telemetry[int(0.99 * len(telemetry))],
        "saved_bytes": float(result.saved[1]),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--fill", action="store_true", help="write the table to docs/benchmarks.md")
    arguments = parser.parse_args()
    heads = ["sent", "channel busy", "video at the base", "maps at the base", "telemetry p99, ms", "not sent, MB"]
    lines = [row(heads), row(["---"] * len(heads))]
    for way, reads in WAYS.items():
        runs = [measure(seed, reads) for seed in range(1, arguments.seeds + 1)]
        median = {figure: statistics.median(run[figure] for run in runs) for figure in runs[0]}
        lines.append(
            row(
                [
                    way,
                    f"{median['busy']:.0%}",
                    f"{median['video']:.0%}",
                    f"{median['map']:.0%}",
                    f"{median['telemetry_p99_s'] * 1e3:.0f}",
                    f"{median['saved_bytes'] / 1e6:.0f}",
                ]
            )
        )
        print(lines[-1], flush=True)
    print("\n".join(lines))
    if arguments.fill:
        fill("subscriptions", "\n".join(lines))


if __name__ == "__main__":
    main()
