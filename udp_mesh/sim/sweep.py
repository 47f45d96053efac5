"""`udp-mesh sim sweep`: many seeds and settings of one scenario, on all cores or a cluster, compared with intervals.

`mesh_sweep` does the work; here is what one case is: the scenario's text with its settings -> `play` -> figures.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from mesh_sweep.cases import Case, Settings
from mesh_sweep.command import Study, SweepOptions, show, sweep
from mesh_sweep.errors import SweepError
from mesh_sweep.results import Identity
from mesh_sweep.revision import check_worker, source_revision
from mesh_sweep.scenario_text import EditedText, fingerprint, with_settings
from udp_mesh.sim.command import NO_SCENARIO, find
from udp_mesh.sim.run import play
from udp_mesh.sim.scenario import Scenario, ScenarioError, parse

SHORT = {"loss": "air.least_loss", "rate": "channel.rate", "range": "air.range_m"}
"""Short names of paths that are swept often."""
NAMED = frozenset({"robots", "relays", "topics"})
SHOWN = ("topics.*.arrived_per_offered", "topics.*.latency_p50_s", "topics.*.latency_p99_s", "channel.airtime_share")
_COMPUTES = ("core", "crypto", "wire", "sim", "report/recording.py")
_ROOT = Path(__file__).parents[1]


def revision() -> str:
    """Of the code that simulates."""
    return source_revision(_ROOT, _COMPUTES)


def run_case(text: str, file: str, expected_revision: str, case: Case) -> dict[str, float | None]:
    """One run on a worker, which may be another machine: it gets the scenario's text."""
    check_worker(expected_revision, revision())
    scenario = replace(_parse(text, file, case.settings), seed=case.seed)
    return figures_of(play(scenario).summary())


def figures_of(summary: Mapping[str, Any]) -> dict[str, float | None]:
    """The numbers of a summary by path; `arrived_per_offered` counts every receiver of a broadcast."""
    counts = ("accepted", "rejected", "delivered", "expired", "peer_lost", "ended_twice")
    figures: dict[str, float | None] = {name: summary[name] for name in counts}
    figures |= {f"channel.{name}": value for name, value in summary["channel"].items()}
    for name, topic in summary["topics"].items():
        figures |= {f"topics.{name}.{figure}": value for figure, value in topic.items()}
        offered = topic["offered"]
        figures[f"topics.{name}.arrived_per_offered"] = topic["arrived"] / offered if offered else None
    figures |= {f"observer_bytes.{name}": value for name, value in summary["observer_bytes"].items()}
    return figures


def study_of(path: Path) -> Study:
    """Raises ScenarioError for an invalid scenario."""
    try:
        raw = path.read_bytes()
    except OSError as error:
        raise ScenarioError(f"{path}: cannot read: {error.strerror}") from error
    scenario = parse(raw, str(path))
    text = raw.decode().removeprefix("\ufeff")
    identity = Identity(scenario.name, fingerprint([text]), revision())
    return Study(
        identity,
        partial(run_case, text, str(path), identity.revision),
        partial(_check, text, str(path)),
        SHOWN,
        (path,),
    )


def _check(text: str, file: str, settings: Settings) -> None:
    _parse(text, file, settings)


def _parse(text: str, file: str, settings: Settings) -> Scenario:
    edited = with_settings(text, settings, file, NAMED)
    try:
        return parse(edited.text.encode(), file)
    except ScenarioError as error:
        words = " ".join(f"--set {path}={value}" for path, value in settings)
        raise SweepError(
            "\n".join(f"{_original_line(line, file, edited)} ({words})" for line in str(error).splitlines())
        ) from None


def _original_line(problem: str, file: str, edited: EditedText) -> str:
    match = re.match(re.escape(file) + r":(\d+):", problem)
    return problem if match is None else f"{file}:{edited.original_line(int(match[1]))}:{problem[match.end() :]}"


def run_sweep(arguments: Sequence[str]) -> int:
    """Exit codes: 0 every case has a result, 1 some have none, 2 could not run, 130 interrupted."""
    options = parser().parse_args(list(arguments))
    given = SweepOptions(
        seeds=options.seeds,
        set=options.set,
        out=options.out,
        jobs=options.jobs,
        dask=options.dask,
        executor=options.executor,
        figures=options.figure,
        goals=options.goal,
        report=options.report,
        as_json=options.json,
    )
    try:
        if options.show is not None:
            return show(options.show, given, SHOWN)
        if options.scenario is None:
            raise SweepError(NO_SCENARIO)
        return sweep(study_of(find(options.scenario)), given, SHORT)
    except (SweepError, ScenarioError) as error:
        sys.stderr.write("".join(f"udp-mesh: {problem}\n" for problem in str(error).splitlines()))
    except OSError as error:
        sys.stderr.write(f"udp-mesh: {f'{error.filename}: {error.strerror}' if error.filename else error}\n")
    return 2


def parser() -> argparse.ArgumentParser:
    """The parser of the command."""
    made = argparse.ArgumentParser(
        prog="udp-mesh sim sweep",
        description="Simulate a scenario with many seeds and settings, and compare the settings with confidence "
        "intervals. Results are appended to a file; the same command continues an interrupted sweep.",
        epilog="exit codes: 0 success, 1 some cases have no result, 2 could not run, 130 interrupted\n\n"
        "examples:\n  udp-mesh sim sweep final-run --seeds 100 --set loss=0,0.1,0.2 --set duration_s=600\n"
        "  udp-mesh sim sweep --show final-run-sweep.jsonl --figure 'topics.estop.*' --report estop.html",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    made.add_argument("scenario", nargs="?", help="scenario file (YAML), or name of a shipped scenario")
    made.add_argument(
        "--seeds", default="20", metavar="N", help="number of seeds, or a range such as 501-1000 (default 20)"
    )
    made.add_argument(
        "--set", action="append", default=[], metavar="PATH=VALUE,...",
        help="values of an entry of the scenario, such as air.least_loss=0,0.1 or flows[0].period_s=1,2; several "
        f"options give every combination; short names: {', '.join(SHORT)}",
    )  # fmt: skip
    made.add_argument("--out", type=Path, metavar="FILE", help="results (default SCENARIO-sweep.jsonl)")
    made.add_argument("--jobs", type=_jobs, default=0, metavar="N", help="processes (default: one for each core)")
    made.add_argument(
        "--dask", default="", metavar="ADDRESS",
        help="run on a Dask cluster: its address, such as tcp://host:8786, or the JSON file of its scheduler",
    )  # fmt: skip
    made.add_argument(
        "--executor", default="", metavar="MODULE:NAME", help="run on another concurrent.futures.Executor"
    )
    made.add_argument(
        "--figure", action="append", default=[], metavar="PATTERN", help="figures to compare, such as 'topics.map.*'"
    )
    made.add_argument(
        "--goal", action="append", default=[], metavar="FIGURE<=N", help="also show the share of runs that meet this"
    )
    made.add_argument("--report", type=Path, metavar="FILE", help="write the comparison as an HTML page")
    made.add_argument("--json", action="store_true", help="print the comparison as JSON")
    made.add_argument("--show", type=Path, metavar="FILE", help="only compare the results of this file")
    return made


def _jobs(text: str) -> int:
    if not (text.isascii() and text.isdecimal() and 1 <= int(text) <= 1024):
        raise argparse.ArgumentTypeError(f"expected 1 to 1024, found {text!r}")
    return int(text)
