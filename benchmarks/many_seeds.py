"""Goals 8 and 9 and the shared logs over many seeds: `python -m benchmarks.many_seeds [--seeds 20] [--fill]`.

The cells of `benchmarks.one_channel` and the ways of `benchmarks.shared_logs`, each with the same seeds, on all cores
by the engine of `udp-mesh sim sweep`. An interrupted run continues. Medians have 95 % intervals of order statistics,
shares of seeds that meet the goal Wilson's. `--tables` prints the results that exist.
"""

from __future__ import annotations

import argparse
import hashlib
import sys
from collections.abc import Sequence
from itertools import accumulate
from math import comb
from pathlib import Path
from statistics import median

from benchmarks import one_channel, shared_logs
from benchmarks.page import fill
from benchmarks.tables import row
from mesh_sweep.cases import Case, Settings, cases_of, parse_seeds, settings_order, settings_text
from mesh_sweep.executors import ProcessWorkers, core_count
from mesh_sweep.intervals import CONFIDENCE, Interval, share_interval
from mesh_sweep.results import Identity, Result, decode
from mesh_sweep.results_file import ResultsFile
from mesh_sweep.run import run_cases
from udp_mesh.sim.sweep import revision

RESULTS = Path(__file__).with_name("results") / "many_seeds.jsonl"
LOGS_S = 1800.0
LOSSES = (0.0, 0.05, 0.2)
HOP_LOSSES = (0.1, 0.3)
RADIOS = ("access categories", "one queue")


def cells() -> list[Settings]:
    """Every cell, those with a goal first."""
    hops = [(("bulk", bulk), ("loss", f"{loss:g}"), ("set", "hops")) for loss in HOP_LOSSES for bulk in ("no", "yes")]
    teams = [
        (("loss", f"{loss:g}"), ("radio", radio), ("robots", str(robots)), ("set", "teams"))
        for robots in (2, 4)
        for radio in RADIOS
        for loss in LOSSES
    ]
    guests = [(("loss", f"{loss:g}"), ("robots", "4"), ("set", "guests")) for loss in LOSSES]
    logs = [(("set", "logs"), ("way", way)) for way in shared_logs.WAYS]
    return [*hops, *teams, *guests, *logs]


def measure(case: Case) -> dict[str, float | None]:
    """One cell with one seed; `met` is 1 if the goal is met."""
    cell = dict(case.settings)
    loss = float(cell.get("loss", 0))
    match cell["set"]:
        case "hops":
            measured = one_channel.hops(loss, bulk=cell["bulk"] == "yes", seed=case.seed)
            met = measured["deviation_s"] < measured["goal_deviation_s"]
        case "teams":
            has_categories = cell["radio"] == RADIOS[0]
            measured = one_channel.team(int(cell["robots"]), loss, access_categories=has_categories, seed=case.seed)
            met = (
                measured["urgent_p99_s"] <= measured["goal_p99_s"] and measured["fairness"] >= one_channel.MIN_FAIRNESS
            )
        case "guests":
            measured = one_channel.guest(int(cell["robots"]), loss, seed=case.seed)
            met = measured["urgent_p99_s"] <= measured["goal_p99_s"]
        case _:
            measured = shared_logs.play(cell["way"], case.seed, LOGS_S)
            measured["arrived_share"] = measured["arrived"] / measured["published"]
            measured["airtime_per_item_s"] = measured["airtime_s"] / measured["published"]
            met = measured["twice"] == 0
    kept = {key: value for key, value in measured.items() if key not in cell and isinstance(value, int | float | None)}
    return {**{key: None if value is None else float(value) for key, value in kept.items()}, "met": float(met)}


def tables(results: Sequence[Result]) -> str:
    """One table per set, with a row per cell; the columns of a cell's settings are in the order of their names."""
    by_cell: dict[Settings, list[Result]] = {}
    for result in sorted(results, key=lambda result: settings_order(result.case.settings)):
        if not result.failed:
            by_cell.setdefault(result.case.settings, []).append(result)
    parts = []
    for name, heads, columns in (
        ("hops", ("bulk besides", "three hops, loss of each"), (("arrived", 100, "arrived, %"),
         ("deviation_s", 1e3, "standard deviation, ms"), ("longest_s", 1, "longest interval, s"))),
        ("teams", ("loss", "radio", "robots"), (("of_ceiling", 1, "of the ack-free ceiling"),
         ("fairness", 1, "fairness"), ("urgent_p99_s", 1e3, "urgent p99 of the worst, ms"))),
        ("guests", ("loss", "robots beside the guest"), (("urgent_p99_s", 1e3, "its urgent p99, ms"),)),
        ("logs", ("way",), (("arrived_share", 100, "arrived, %"), ("delay_p50_s", 1, "median delay, s"),
         ("airtime_per_item_s", 1e3, "airtime per item, ms"))),
    ):  # fmt: skip
        cells_of_set = {key: runs for key, runs in by_cell.items() if ("set", name) in key}
        if not cells_of_set:
            continue
        met_head = "nothing arrives twice" if name == "logs" else "goal met"
        lines = [row([*heads, "seeds", *(head for _, _, head in columns), met_head])]
        lines.append(row(["---"] * (len(heads) + len(columns) + 2)))
        for key, runs in cells_of_set.items():
            labels = [_label(path, value) for path, value in key if path != "set"]
            medians = [_median(runs, figure, factor) for figure, factor, _ in columns]
            lines.append(row([*labels, str(len(runs)), *medians, _met(runs)]))
        parts.append("\n".join(lines))
    return "\n\n".join(parts)


def _label(path: str, value: str) -> str:
    return f"{float(value):.0%}" if path == "loss" else value


def _median(runs: Sequence[Result], figure: str, factor: float) -> str:
    values = [value * factor for run in runs if (value := run.figures[figure]) is not None]
    return _shown(median_interval(values)) if values else "none"


def median_interval(values: Sequence[float], confidence: float = CONFIDENCE) -> Interval:
    """The median, and the k-th smallest and largest of the values with the largest k for which both enclose the
    distribution's median with this confidence, whatever the distribution. There is no k for fewer than six values."""
    ordered, count = sorted(values), len(values)
    # the chance that at most k values lie below the distribution's median
    below = accumulate(comb(count, k) / 2**count for k in range(count))
    outside = sum(chance <= (1 - confidence) / 2 for chance in below)
    if outside == 0:
        return Interval(median(ordered), None, None)
    return Interval(median(ordered), ordered[outside - 1], ordered[-outside])


def _shown(interval: Interval) -> str:
    if interval.low is None or interval.high is None:
        return f"{interval.estimate:.4g}"
    return f"{interval.estimate:.4g} ({interval.low:.4g} to {interval.high:.4g})"


def _met(runs: Sequence[Result]) -> str:
    met = sum(run.figures["met"] == 1.0 for run in runs)
    share = share_interval(met, len(runs))
    return f"{met} of {len(runs)} ({share.low:.0%} to {share.high:.0%})"


def identity() -> Identity:
    sources = b"".join(Path(str(module.__file__)).read_bytes() for module in (one_channel, shared_logs))
    return Identity("many-seeds", hashlib.sha256(sources).hexdigest()[:16], revision())


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.many_seeds", description=__doc__)
    parser.add_argument("--seeds", default="20", help="how many, or a range such as 21-40")
    parser.add_argument("--sets", nargs="*", default=["hops", "teams", "guests", "logs"])
    parser.add_argument("--only", default="", help="cells that contain this, such as bulk=no")
    parser.add_argument("--jobs", type=int, default=core_count())
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--fill", action="store_true", help="write the tables to docs/benchmarks.md")
    parser.add_argument("--tables", action="store_true", help="only print the tables of existing results")
    arguments = parser.parse_args()
    if not arguments.tables:
        chosen = [
            cell for cell in cells() if dict(cell)["set"] in arguments.sets and arguments.only in settings_text(cell)
        ]
        with ResultsFile(arguments.results, identity()) as file:
            results = {result.case: result for result in file.stored.results}
            missing = [case for case in cases_of(chosen, parse_seeds(arguments.seeds)) if case not in results]
            try:
                for number, result in enumerate(run_cases(missing, measure, ProcessWorkers(arguments.jobs)), 1):
                    file.append(result)
                    results[result.case] = result
                    print(f"{number} of {len(missing)}: {result.case}", file=sys.stderr, flush=True)
            except KeyboardInterrupt:
                sys.exit(130)
            file.finish(results.values())
    stored = decode(arguments.results.read_bytes(), str(arguments.results))
    text = f"udp_mesh {stored.identity.revision}\n\n{tables(stored.results)}"
    print(text)
    if arguments.fill:
        fill("many seeds", text)


if __name__ == "__main__":
    main()
