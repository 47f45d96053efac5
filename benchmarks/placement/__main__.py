"""Compare the laws: `python -m benchmarks.placement [--tunnels 60] [--beacons 6] [--fill]`.

Each finished tunnel is appended to the results at once; tunnels that have results are not driven again.
"""

from __future__ import annotations

import argparse
import json
import random
import statistics
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.page import fill
from benchmarks.placement.drive import drive, reach_m
from benchmarks.placement.rules import Bobcat, ByMeter, Ladder, Rule, Threshold
from benchmarks.placement.tunnels import MODELS, tunnel
from benchmarks.tables import row

RESULTS = Path(__file__).parents[1] / "results" / "placement.jsonl"
RULES: dict[str, Callable[[], Rule]] = {
    "meter": ByMeter,
    "BOBCAT 200/200": lambda: Bobcat(200, 200),
    "BOBCAT 100/30": lambda: Bobcat(100, 30, redeploy_m=10),
    "ladder of RSSI to the base": Ladder,
    "-75 dBm to the next hop": lambda: Threshold(-75),
    "-80 dBm to the next hop": lambda: Threshold(-80),
}
OUTAGES = (0.0, 0.01, 0.05, 0.1)
BEACONS = (3, 6)
NAMES = {"lab": "the lab's log-distance model", "subt": "DARPA's model"}
_DRAWS = 2000


def measure(model: str, seed: int, beacons: int) -> dict[str, Any]:
    """One tunnel, driven by every law: meters reached at each share of outage."""
    ground = tunnel(model, seed)
    reached = {}
    for name, make in RULES.items():
        run = drive(ground, make(), beacons, seed)
        reached[name] = {
            **{f"{outage:g}": reach_m(run, outage) for outage in OUTAGES},
            "seconds": len(run),
            "beacons_left": run[-1].beacons,
        }
    return {"model": model, "seed": seed, "beacons": beacons, "reached": reached}


def interval(values: Sequence[float], draw: random.Random) -> tuple[float, float]:
    """The 95 % confidence interval of the median (percentile bootstrap, Efron)."""
    medians = sorted(statistics.median(draw.choices(values, k=len(values))) for _ in range(_DRAWS))
    return medians[round(0.025 * _DRAWS)], medians[round(0.975 * _DRAWS) - 1]


def report(results: Sequence[Mapping[str, Any]]) -> str:
    """One table per model and stock; the last column compares the meter with the law, tunnel by tunnel."""
    draw = random.Random(0)
    lines: list[str] = []
    for model in MODELS:
        for beacons in sorted({result["beacons"] for result in results}):
            chosen = [result for result in results if result["model"] == model and result["beacons"] == beacons]
            if not chosen:
                continue
            lines += ["", f"{beacons} beacons, {NAMES[model]}, {len(chosen)} tunnels:", ""]
            lines.append(row(["law", *(f"{outage:.0%} outage, m" for outage in OUTAGES), "meter over this law at 5 %"]))
            lines.append(row(["---"] * (2 + len(OUTAGES))))
            for name in RULES:
                cells = [name]
                for outage in OUTAGES:
                    values = [result["reached"][name][f"{outage:g}"] for result in chosen]
                    low, high = interval(values, draw)
                    cells.append(f"{statistics.median(values):.0f} ({low:.0f}-{high:.0f})")
                gains = [result["reached"]["meter"]["0.05"] - result["reached"][name]["0.05"] for result in chosen]
                low, high = interval(gains, draw)
                won = sum(gain > 0 for gain in gains)
                gain_text = f"{statistics.median(gains):+.0f} m ({low:+.0f} to {high:+.0f}), {won} of {len(gains)}"
                lines.append(row([*cells, "" if name == "meter" else gain_text]))
    return "\n".join(lines[1:])


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.placement", description=__doc__)
    parser.add_argument("--tunnels", type=int, default=60, help="number of seeded tunnels")
    parser.add_argument("--beacons", type=int, nargs="*", default=list(BEACONS), help="beacons that a robot carries")
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--fill", action="store_true", help="write the tables to docs/benchmarks.md")
    parser.add_argument("--tables", action="store_true", help="only print the tables of existing results")
    arguments = parser.parse_args()
    file: Path = arguments.results
    results = [json.loads(line) for line in file.read_text().splitlines()] if file.exists() else []
    known = {(result["model"], result["seed"], result["beacons"]) for result in results}
    if not arguments.tables:
        for seed in range(arguments.tunnels):
            for model in MODELS:
                for beacons in arguments.beacons:
                    if (model, seed, beacons) not in known:
                        results.append(measure(model, seed, beacons))
                        with file.open("a") as opened:
                            opened.write(json.dumps(results[-1]) + "\n")
            print(f"{seed + 1} of {arguments.tunnels} tunnels", file=sys.stderr)
    print(report(results))
    if arguments.fill:
        fill("placement", report(results))


if __name__ == "__main__":
    main()
