"""Pause of telemetry when a relay dies: `python -m benchmarks.reconvergence_udp_mesh [--fill] [--tables]`.

For each routing algorithm and interval of batman-adv, on the kernel's 802.11 radios (`reconvergence_fleet`):

    configure -> wait until the mesh has settled -> capture batman-adv's own packets
      -> for each run: silence the active relay, measure the longest pause between two messages, restore the relay

Each run and each failure is appended to the results at once; a case that has its runs is not measured again. A case
that fails is reported and the next one starts; a machine that ends is restarted once. `--within` divides the time among
the remaining cases: each gets at least one run, and more if there is time.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks.page import fill
from benchmarks.reconvergence_fleet import OVERHEARD_S, Bench, Case, NoPauseError, bench
from meshctl.errors import MeshctlError

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks" / "results" / "reconvergence_udp_mesh.jsonl"
PAGE = ROOT / "docs" / "reconvergence.md"
ALGORITHMS = ("BATMAN_IV", "BATMAN_V")
INTERVALS_MS = (1000, 500, 250, 100)
CASES = tuple(Case(algorithm, interval_ms) for algorithm in ALGORITHMS for interval_ms in INTERVALS_MS)
_BOOTS = 2
# the time limit of one case
_CASE_S = 420.0
# tolerated runs in which telemetry had just switched to the other route by itself
_MISSES = 6


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.reconvergence_udp_mesh", description=__doc__)
    parser.add_argument(
        "--case", action="append", default=[], help="only this case, such as BATMAN_IV:250 (repeatable)"
    )
    parser.add_argument("--runs", type=int, default=5, help="number of runs of each case")
    parser.add_argument("--within", type=float, default=0.0, help="total time limit in minutes; 0: no limit")
    parser.add_argument("--again", action="store_true", help="discard the results of these cases and measure again")
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--tables", action="store_true", help="only print the table of existing results")
    parser.add_argument("--fill", action="store_true", help="write the table to docs/reconvergence.md")
    arguments = parser.parse_args()
    unknown = [name for name in arguments.case if name not in map(str, CASES)]
    if unknown:
        parser.error(f"--case: expected one of {', '.join(map(str, CASES))}, found {', '.join(unknown)}")
    cases = [case for case in CASES if not arguments.case or str(case) in arguments.case]
    if not arguments.tables:
        arguments.results.parent.mkdir(parents=True, exist_ok=True)
        if arguments.again:
            forget(arguments.results, cases)
        within_s = 60 * arguments.within or float("inf")
        Measuring(arguments.results, arguments.runs, time.monotonic() + within_s).all(cases)
    text = table(recorded(arguments.results))
    print(text)
    if arguments.fill:
        fill("reconvergence", text, PAGE)


# -- measuring --


class Measuring:
    """Measures cases in order until `ends_s` (monotonic), and appends each run to the file `results`."""

    def __init__(self, results: Path, runs: int, ends_s: float) -> None:
        self._results = results
        self._runs = runs
        self._ends_s = ends_s

    def all(self, cases: list[Case]) -> None:
        """Measure every case that lacks runs; each is started once."""
        todo = [case for case in cases if self._done(case) < self._runs]
        for boot in range(1, _BOOTS + 1):
            if not todo or time.monotonic() >= self._ends_s:
                break
            try:
                with tempfile.TemporaryDirectory() as folder, bench(Path(folder)) as made:
                    self._in_machine(made, todo)
            except (MeshctlError, OSError, RuntimeError) as error:
                _say(f"machine {boot}: {error}")
        for case in todo:
            self._write(case, failed="not begun: no machine, or no time left")

    def _in_machine(self, made: Bench, todo: list[Case]) -> None:
        """Measure and remove the cases of `todo`. Raises the error with which the machine ended."""
        while todo and time.monotonic() < self._ends_s:
            case = todo[0]
            share_s = (self._ends_s - time.monotonic()) / len(todo)
            begun_s = time.monotonic()
            made.ends_s = min(begun_s + _CASE_S, self._ends_s)
            del todo[0]
            try:
                self._case(made, case, begun_s + share_s)
            except (MeshctlError, OSError, RuntimeError, ValueError, KeyError, NoPauseError) as error:
                reason = str(error).splitlines()[0] if str(error) else type(error).__name__
                _say(f"{case} failed after {time.monotonic() - begun_s:.0f} s: {reason}")
                self._write(case, failed=reason)
                made.check_runs()
            else:
                _say(f"{case} took {time.monotonic() - begun_s:.0f} s")

    def _case(self, made: Bench, case: Case, share_ends_s: float) -> None:
        """Measure the runs of a case; after the first, only runs that are likely to end before `share_ends_s`."""
        made.configure(case)
        made.settle(case)
        overheard = made.overheard()
        misses, last_s = 0, 0.0
        while self._done(case) < self._runs and (not last_s or time.monotonic() + last_s < share_ends_s):
            begun_s = time.monotonic()
            if last_s:
                made.settle(case)
            try:
                pause_s = made.pause_s()
            except NoPauseError as miss:
                misses += 1
                _say(f"{case}: {miss}")
                if misses > _MISSES:
                    raise
            else:
                self._write(case, pause_s=round(pause_s, 2), overheard=overheard, load=round(os.getloadavg()[0], 1))
                _say(f"{case} run {self._done(case)}: {pause_s:.2f} s")
            last_s = time.monotonic() - begun_s

    def _done(self, case: Case) -> int:
        return sum(is_of(result, case) and "pause_s" in result for result in recorded(self._results))

    def _write(self, case: Case, **words: Any) -> None:
        line = json.dumps({"algorithm": case.algorithm, "interval_ms": case.interval_ms, **words})
        with self._results.open("a", encoding="utf-8") as file:
            file.write(f"{line}\n")


def _say(text: str) -> None:
    print(f"{time.strftime('%H:%M:%S', time.gmtime())} {text}", file=sys.stderr, flush=True)


# -- airtime --


def airtime_us(rate: int, length: int, kind: str) -> float:
    """Airtime of one transmission in microseconds: DIFS, the mean back-off, the frame, and a probe's acknowledgment.

    IEEE 802.11-2020 clauses 15 (DSSS), 17 (OFDM) and 19 (HT, if the rate is unknown: MCS 7, 65 Mbit/s); slots of
    9 us, a first contention window of 15 slots.
    """
    spacing_us = 28 + 7.5 * 9
    bits = 8 * (length + 4)
    mbit_s = rate / 2
    if mbit_s in (1, 2, 5.5, 11):
        frame_us = 192 + bits / mbit_s
    elif mbit_s:
        frame_us = 20 + 4 * -(-(22 + bits) // int(4 * mbit_s)) + 6
    else:
        frame_us = 36 + 4 * -(-(22 + bits) // 260) + 6
    # broadcasts are not acknowledged; a probe's acknowledgment is sent at 6 Mbit/s
    acknowledged_us = 10 + 44 if kind == "probe" else 0
    return spacing_us + frame_us + acknowledged_us


def share_of_air(overheard: list[dict[str, Any]]) -> float:
    """The share (0..1) of a common channel that batman-adv's own packets use."""
    total_us: float = sum(
        frames["count"] * airtime_us(frames["rate"], frames["bytes"], frames["kind"]) for frames in overheard
    )
    return total_us / (OVERHEARD_S * 1e6)


# -- results --


def recorded(path: Path) -> list[dict[str, Any]]:
    """Every recorded run and failure, in order."""
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()] if path.exists() else []


def is_of(result: dict[str, Any], case: Case) -> bool:
    return (result["algorithm"], result["interval_ms"]) == (case.algorithm, case.interval_ms)


def forget(path: Path, cases: list[Case]) -> None:
    """Remove all results of these cases."""
    kept = [result for result in recorded(path) if not any(is_of(result, case) for case in cases)]
    path.write_text("".join(f"{json.dumps(result)}\n" for result in kept), encoding="utf-8")


def table(results: list[dict[str, Any]]) -> str:
    """One row per case: number, median and range of the pauses, and batman-adv's overhead."""
    lines = [
        "| algorithm | interval | runs | telemetry pauses for: median (range) | packets/s of its own | of the air |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for case in CASES:
        of_case = [result for result in results if is_of(result, case)]
        runs = [result for result in of_case if "pause_s" in result]
        if runs:
            pauses = [run["pause_s"] for run in runs]
            rate = statistics.median(sum(item["count"] for item in run["overheard"]) / OVERHEARD_S for run in runs)
            share = statistics.median(share_of_air(run["overheard"]) for run in runs)
            cells = f"{len(runs)} | {_median_and_range(pauses)} | {rate:.0f} | {share:.2%}"
        elif of_case:
            cells = f"0 | failed: {of_case[-1]['failed'].replace('|', '/')} | - | -"
        else:
            cells = "0 | not measured | - | -"
        lines.append(f"| {case.algorithm} | {case.interval_ms} ms | {cells} |")
    return "\n".join(lines)


def _median_and_range(pauses_s: list[float]) -> str:
    if len(pauses_s) == 1:
        return f"{pauses_s[0]:.1f} s"
    return f"{statistics.median(pauses_s):.1f} s ({min(pauses_s):.1f}-{max(pauses_s):.1f})"


if __name__ == "__main__":
    main()
