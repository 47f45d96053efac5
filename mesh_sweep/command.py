"""The common part of `udp-mesh sim sweep` and `meshctl lab sweep`, from parsed options to the exit code."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from mesh_sweep.cases import Settings, cases_of, combinations, parse_parameters, parse_seeds
from mesh_sweep.comparison import Comparison, Goal, as_json, as_text, check_figures, compare, parse_goals
from mesh_sweep.errors import SweepError
from mesh_sweep.executors import DaskWorkers, OtherWorkers, ProcessWorkers, Workers, core_count
from mesh_sweep.page import page
from mesh_sweep.results import Identity, Result, decode
from mesh_sweep.results_file import ResultsFile
from mesh_sweep.run import RunCase, run_cases

_LINE_EVERY_S = 60.0
_SHOWN_FAILURES = 10


@dataclass(frozen=True, slots=True)
class Study:
    """A scenario to sweep: `check` raises SweepError for settings that it does not accept; `figures` are the patterns
    of those that are shown by default, `inputs` the files of the scenario."""

    identity: Identity
    run: RunCase
    check: Callable[[Settings], None]
    figures: tuple[str, ...]
    inputs: tuple[Path, ...] = ()


@dataclass(frozen=True, slots=True)
class SweepOptions:
    """The options of both commands. `jobs` 0: one for each core."""

    seeds: str = "20"
    set: Sequence[str] = ()
    out: Path | None = None
    jobs: int = 0
    dask: str = ""
    executor: str = ""
    figures: Sequence[str] = ()
    goals: Sequence[str] = ()
    report: Path | None = None
    as_json: bool = False

    def workers(self) -> Workers:
        """Raises SweepError for options that exclude each other."""
        if self.dask and self.executor:
            raise SweepError("expected --dask or --executor, found both")
        jobs = self.jobs or core_count()
        return DaskWorkers(self.dask) if self.dask else (
            OtherWorkers(self.executor, jobs) if self.executor else ProcessWorkers(jobs)
        )  # fmt: skip


def sweep(study: Study, options: SweepOptions, short: dict[str, str]) -> int:
    """Run what has no result yet, then print the comparison. `short` gives the paths of short names.

    Exit codes: 0 every case has figures, 1 some failed, 130 interrupted. Raises SweepError and OSError.
    """
    seeds = parse_seeds(options.seeds)
    settings = combinations(parse_parameters(options.set, short))
    cases = cases_of(settings, seeds)
    _check_all(settings, study.check)
    goals = parse_goals(options.goals)
    workers = options.workers()
    out = options.out or Path(f"{study.identity.scenario}-sweep.jsonl")
    _check_report(options.report, out, study.inputs)
    if options.report is not None:
        # before hours of work
        with options.report.open("ab") as opened:
            is_new = opened.tell() == 0
        if is_new:
            options.report.unlink()
    with ResultsFile(out, study.identity) as file:
        if file.repaired_bytes:
            _note(f"{out}: cut off an incomplete last line of {file.repaired_bytes} bytes; its case runs again")
        results = {stored_result.case: stored_result for stored_result in file.stored.results}
        missing = [case for case in cases if case not in results or results[case].failed]
        if len(missing) < len(cases):
            _note(f"{out}: {len(cases) - len(missing)} of {len(cases)} cases have a result already")
        progress = _Progress(len(missing))
        try:
            for result in run_cases(missing, study.run, workers, progress.show):
                file.append(result)
                results[result.case] = result
                if not result.failed and progress.done == progress.failed:
                    _warn_of_unknown_figures(result, options.figures, goals, progress)
                progress.add(result)
        except KeyboardInterrupt:
            progress.end()
            have = len(cases) - len(missing) + progress.done
            _note(f"interrupted: {have} of {len(cases)} cases are in {out}; run the same command to continue")
            return 130
        progress.end()
        try:
            file.finish(results.values())
        except OSError as error:
            _note(f"warning: {out} is not sorted: {error.strerror}; all results are there")
    return _show(study.identity, [results[case] for case in cases], options, study.figures)


def show(file: Path, options: SweepOptions, default_figures: tuple[str, ...]) -> int:
    """Compare the results of a file, of whatever scenario and revision. Raises SweepError and OSError."""
    _check_report(options.report, file)
    stored = decode(file.read_bytes(), str(file))
    return _show(stored.identity, stored.results, options, default_figures)


def _check_report(report: Path | None, results: Path, inputs: Sequence[Path] = ()) -> None:
    """Raise SweepError for a report that would replace the results, or a file of the scenario."""
    if report is None:
        return
    if report.resolve() == results.resolve():
        raise SweepError(f"--report {report}: expected another file than that of the results: give it another name")
    if report.resolve() in [each.resolve() for each in inputs]:
        raise SweepError(f"--report {report}: expected another file than those of the scenario: give it another name")


def _show(
    identity: Identity, results: Sequence[Result], options: SweepOptions, default_figures: tuple[str, ...]
) -> int:
    comparison = compare(results, options.figures or _existing(default_figures, results), parse_goals(options.goals))
    if options.report is not None:
        options.report.write_text(page(identity, comparison), encoding="utf-8")
    if options.as_json:
        text = json.dumps({**asdict(identity), **as_json(comparison)}, indent=2)
    else:
        text = f"{comparison.runs} runs of {identity}\n{as_text(comparison)}"
    sys.stdout.write(f"{text}\n")
    _list_failures(comparison)
    return 1 if comparison.failed else 0


def _warn_of_unknown_figures(
    result: Result, patterns: Sequence[str], goals: Sequence[Goal], progress: _Progress
) -> None:
    """After the first result, before hours of work; only a warning, because another seed or setting may have them."""
    try:
        check_figures(result, patterns, goals)
    except SweepError as error:
        progress.end()
        _note(f"warning: --figure or --goal: {error} (after the first result; Ctrl-C keeps the results)")


def _existing(patterns: Iterable[str], results: Sequence[Result]) -> list[str]:
    """The default patterns that some result matches: not every scenario has every figure."""
    found = []
    for pattern in patterns:
        try:
            compare(results, [pattern])
        except SweepError:
            continue
        found.append(pattern)
    return found


def _check_all(settings: Sequence[Settings], check: Callable[[Settings], None]) -> None:
    """Raises SweepError with each problem once, before anything runs."""
    problems: dict[str, None] = {}
    for setting in settings:
        try:
            check(setting)
        except SweepError as error:
            problems.update(dict.fromkeys(str(error).splitlines()))
    if problems:
        lines = list(problems)
        more = [f"... and {len(lines) - 20} more"] if len(lines) > 20 else []
        raise SweepError("\n".join([*lines[:20], *more]))


def _list_failures(comparison: Comparison) -> None:
    for failure in comparison.failed[:_SHOWN_FAILURES]:
        _note(f"no result: {failure.case}: {failure.failed}")
    if comparison.failed:
        count = len(comparison.failed)
        _note(f"{count} of {comparison.runs + count} cases have no result; the same command runs them again")


def _note(text: str) -> None:
    sys.stderr.write(f"{text}\n")
    sys.stderr.flush()


class _Progress:
    """A line that is rewritten on a terminal, one line a minute elsewhere."""

    def __init__(self, total: int) -> None:
        self.total, self.done, self.failed = total, 0, 0
        self._started_s = self._shown_s = time.monotonic()
        self._is_terminal = sys.stderr.isatty()

    def add(self, result: Result) -> None:
        self.done += 1
        self.failed += bool(result.failed)
        self.show()

    def show(self) -> None:
        now = time.monotonic()
        if self.total and now - self._shown_s >= (0.2 if self._is_terminal else _LINE_EVERY_S):
            self._shown_s = now
            sys.stderr.write(f"\r{self._text(now)}\x1b[K" if self._is_terminal else f"{self._text(now)}\n")
            sys.stderr.flush()

    def _text(self, now: float) -> str:
        failed = f", {self.failed} without a result" if self.failed else ""
        left = ""
        if self.done:
            left_s = (now - self._started_s) / self.done * (self.total - self.done)
            left = f", about {left_s / 60:.0f} min left" if left_s >= 90 else f", about {left_s:.0f} s left"
        return f"{self.done} of {self.total} cases{failed}{left}"

    def end(self) -> None:
        if self._is_terminal and self.total:
            sys.stderr.write("\r\x1b[K")
            sys.stderr.flush()
