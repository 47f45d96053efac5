"""`meshctl history`: past runs from the journal; needs neither an inventory nor a node."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime
from itertools import islice, zip_longest
from typing import Annotated, Any

import typer

from meshctl.cli.context import AsJson, line_width
from meshctl.cli.history_follow import concerns, is_pattern
from meshctl.cli.history_follow import follow as follow_runs
from meshctl.cli.output import echo, echo_error, echo_json, terminal_width
from meshctl.cli.run_record import run_number
from meshctl.errors import InputError
from meshctl.fleet import Result
from meshctl.fleet.journal import Journal, RunRecord
from meshctl.fleet.journal_store import open_journal
from meshctl.fleet.run_files import CHANGES, RunFiles
from meshctl.plan.values import FileChange
from meshctl.report import text_table
from meshctl.report.changed_options import diff_lines, summary
from meshctl.report.line_wrap import wrap
from meshctl.report.terminal_escapes import clean


def history(
    run: Annotated[
        str | None, typer.Argument(help="Run number, or `last` for the latest run; shows its nodes and steps.")
    ] = None,
    node: Annotated[
        str | None, typer.Option("--node", help="Only runs or steps of this node: a name or a pattern.")
    ] = None,
    fleet: Annotated[str | None, typer.Option("--fleet", help="Only runs of this fleet.")] = None,
    lab: Annotated[
        bool | None, typer.Option("--virtual/--real", help="Only runs in a lab, or only on real nodes.")
    ] = None,
    diff: Annotated[bool, typer.Option("--diff", help="With a run number: show file diffs.")] = False,
    limit: Annotated[int, typer.Option("--limit", "-n", min=1, help="Maximum number of runs.")] = 20,
    follow: Annotated[
        bool, typer.Option("--follow", "-f", help="Show new events as they happen, until Ctrl-C.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Show past runs; with a run number, its nodes, changed settings, steps, outcomes and durations.

    Example: meshctl history 12 --node b03
    """
    if node is not None and (set(node) & set("@!:,") or not node):
        raise InputError(
            f"--node {node}: expected a name or a pattern such as 'b*'",
            hint="history needs no inventory, so it knows no groups",
        )
    if follow and run is not None:
        raise InputError("--follow shows all runs", hint="leave out the run number, or narrow with --node")
    # runs of labs are in the journal of this computer, not in a shared one
    in_use = os.environ.get("MESHCTL_LAB", "") if lab is None else ""
    with open_journal(
        os.environ, echo_error, lab=in_use, changes_nothing=True, of_this_computer=lab is True, for_display=True
    ) as journal:
        run_filter = _RunFilter(node, fleet, lab)
        if follow:
            follow_runs(journal, run_filter.matches, node, as_json=as_json)
        elif run is None:
            _list_runs(journal, run_filter, limit, as_json=as_json)
        else:
            number = run_number(run, _selected_runs(journal, run_filter), of=run_filter.text)
            _show_run(journal, number, node, as_json=as_json, with_diffs=diff)


@dataclass(frozen=True, slots=True)
class _RunFilter:
    """Selects the runs to list; None matches all."""

    node: str | None
    fleet: str | None
    is_virtual: bool | None

    def matches(self, record: RunRecord) -> bool:
        return self.fleet in (None, record.fleet) and self.is_virtual in (None, bool(record.lab))

    @property
    def text(self) -> str:
        """` of b03 of fleet cave in a lab`; empty if it matches all."""
        node = "" if self.node is None else f" of {self.node}"
        fleet = "" if self.fleet is None else f" of fleet {self.fleet}"
        where = {None: "", True: " in a lab", False: " on real nodes"}[self.is_virtual]
        return f"{node}{fleet}{where}"


def _selected_runs(journal: Journal, run_filter: _RunFilter) -> Iterator[RunRecord]:
    """Newest first."""
    node = run_filter.node
    found = journal.runs(node=None if is_pattern(node) else node, limit=None)
    if is_pattern(node):
        found = tuple(run for run in found if any(concerns(node, outcome.node) for outcome in journal.outcomes(run.id)))
    return (record for record in found if run_filter.matches(record))


def _list_runs(journal: Journal, run_filter: _RunFilter, limit: int, *, as_json: bool) -> None:
    records = tuple(islice(_selected_runs(journal, run_filter), limit))
    if as_json:
        echo_json(json.dumps([_run_object(record) for record in records], indent=1))
        return
    # several fleets may have a node of this name: group its runs by fleet
    by_fleet: dict[tuple[str, str], list[RunRecord]] = {}
    for record in records:
        by_fleet.setdefault((record.fleet, record.lab) if run_filter.node is not None else ("", ""), []).append(record)
    for number, (key, group) in enumerate(by_fleet.items()):
        if run_filter.node is not None and len(by_fleet) > 1:
            echo(("\n" if number else "") + f"{run_filter.node} of {_fleet_text(*key)}")
        _list_group(journal, group, run_filter.node)
    if not records:
        echo(f"no runs{run_filter.text} yet")
        if fleets := dict.fromkeys(run.fleet for run in journal.runs(limit=None)):
            echo(f"the journal has runs of {', '.join(fleets)}")


def _list_group(journal: Journal, records: list[RunRecord], node: str | None) -> None:
    rows = [("RUN", "STARTED", "COMMAND", "FLEET", "BY", "RESULT")]
    rows += [
        (
            str(listed_record.id),
            _moment(listed_record.began_s),
            listed_record.command,
            _fleet_text(listed_record.fleet, listed_record.lab),
            listed_record.owner,
            listed_record.state,
        )
        for listed_record in records
    ]
    room = max(len(row[0]) for row in rows)
    heading, *cells = ((row[0].rjust(room), *row[1:]) for row in rows)
    leave_out = ("BY", "FLEET", "COMMAND")
    width = terminal_width(sys.stdout)
    lines = text_table.lines(heading, cells, width, leave_out=leave_out)
    for line, record in zip_longest(lines, (None, *records)):
        echo(line)
        for outcome in journal.outcomes(record.id) if record is not None and node is not None else ():
            if concerns(node, outcome.node):
                for part in wrap(f"{'':{room}}  {outcome}", width):
                    echo(part)


def _fleet_text(fleet: str, lab: str) -> str:
    return f"{fleet} (lab)" if lab else fleet


def _show_run(journal: Journal, run_id: int, node: str | None, *, as_json: bool, with_diffs: bool) -> None:
    record = journal.run(run_id)
    if record is None:
        raise InputError(f"run {run_id} does not exist", hint="run `meshctl history` to list all runs")
    outcomes = [outcome for outcome in journal.outcomes(run_id) if concerns(node, outcome.node)]
    if not outcomes and node is not None:
        raise InputError(f"{node} was not part of run {run_id}", hint=f"`meshctl history {run_id}` lists its nodes")
    steps = [step for step in journal.steps(run_id) if concerns(node, step.node)]
    changes = _changes(journal, run_id)
    if as_json:
        document = {
            **_run_object(record),
            "outcomes": [{"node": o.node, "result": o.result.value, "reason": o.reason} for o in outcomes],
            "changes": [
                {"node": o.node, "path": f"/{each.path}", "kind": each.kind, "diff": each.diff}
                for o in outcomes
                for each in changes.get(o.node, ())
            ],
            "steps": [
                {"node": s.node, "step": s.step, "began_s": s.began_s, "duration_s": s.duration_s, "result": s.result}
                for s in steps
            ],
        }
        echo_json(json.dumps(document, indent=1))
        return
    fleet = _fleet_text(record.fleet, record.lab)
    _echo_wrapped(f"run {record.id}: {record.command} of {fleet} by {record.owner}, {_moment(record.began_s)}")
    _echo_wrapped(f"  {record.inventory}: {record.state}")
    width = max((len(step.step) for step in steps), default=0)
    for outcome in outcomes:
        _echo_wrapped(f"{outcome}" + (f" ({outcome.duration_s:.1f} s)" if outcome.duration_s else ""))
        for change in changes.get(outcome.node, ()):
            _echo_wrapped(f"  {_kept(outcome.result)}{change.kind} /{change.path}: {summary(change)}".rstrip(": "))
            if with_diffs:
                for line in diff_lines(change):
                    echo(f"    {line}")
        for step in steps:
            if step.node == outcome.node:
                took = "interrupted" if step.duration_s is None else f"{step.duration_s:.2f} s"
                result = "" if step.result == "done" else step.result
                _echo_wrapped(f"  {step.step:<{width}} {took:>10}  {result}".rstrip())


def _kept(result: Result) -> str:
    """What became of a node's planned changes; empty if they are in force."""
    if result is Result.DONE:
        return ""
    return "rolled back: " if result is Result.ROLLED_BACK else "planned: "


def _echo_wrapped(text: str) -> None:
    for line in wrap(clean(text), line_width()):
        echo(line)


def _changes(journal: Journal, run_id: int) -> dict[str, tuple[FileChange, ...]]:
    """Planned changes of each node; empty for runs of other commands and versions."""
    saved = RunFiles(journal.path).load(run_id, CHANGES) or {}
    return {
        node: tuple(FileChange(str(path), str(kind), str(diff)) for path, kind, diff in files)
        for node, files in saved.items()
    }


def _run_object(record: RunRecord) -> dict[str, Any]:
    return {
        "run": record.id,
        "command": record.command,
        "fleet": record.fleet,
        "lab": record.lab,
        "inventory": record.inventory,
        "owner": record.owner,
        "began_s": record.began_s,
        "ended_s": record.ended_s,
        "state": record.state,
    }


def _moment(seconds: float) -> str:
    return datetime.fromtimestamp(seconds).astimezone().isoformat(sep=" ", timespec="seconds")
