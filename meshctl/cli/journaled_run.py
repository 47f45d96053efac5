"""A run of any command: journal entry -> progress and signals while the block works -> totals in the journal and on
the screen -> exit code. Provisioning, bootstrap, restore and the robots' commands all use it.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

import typer

from meshctl.cli.context import Session, exit_for, progress_for
from meshctl.cli.output import echo, echo_json, ignore_broken_pipe
from meshctl.fleet import Outcome, totals
from meshctl.fleet.journal import Run

if TYPE_CHECKING:
    from meshctl.report.progress import RunProgress


@dataclass(slots=True)
class JournaledRun:
    """A run in progress; the block adds to `outcomes`."""

    entry: Run
    progress: RunProgress
    outcomes: dict[str, Outcome]


@contextmanager
def journaled_run(
    opened: Session, command: str, names: Sequence[str], *, plan: str = "", as_json: bool
) -> Iterator[JournaledRun]:
    """Record a run of `command` on the nodes or robots `names`; `plan` is what `meshctl resume` needs.

    SIGINT, SIGTERM and SIGHUP within the block request a stop. The run ends in the journal in any case.
    """
    entry = opened.journal.begin(
        command, fleet=opened.fleet.name, inventory=opened.inventory, nodes=tuple(names), plan=plan
    )
    outcomes: dict[str, Outcome] = {}
    try:
        with (
            progress_for(len(names), as_json=as_json) as progress,
            opened.interrupt.on_signals(progress.stopping),
        ):
            yield JournaledRun(entry, progress, outcomes)
    finally:
        entry.end(str(totals(outcomes.values())) if outcomes else "could not run")
    if entry.error:
        with ignore_broken_pipe():
            echo(f"the journal is incomplete: {entry.error}", err=True)
            echo("hint: `meshctl resume` checks the missing nodes again", err=True)


def print_totals(opened: Session, run: JournaledRun, *, as_json: bool, unfinished: str = "nodes") -> typer.Exit:
    """Print the totals, with `as_json` as the event `ended`; returns the exit to raise."""
    counted = totals(run.outcomes.values())
    # a closed pipe or terminal must not change the exit code
    with ignore_broken_pipe():
        if as_json:
            from meshctl.report.progress import outcome_object

            objects = [outcome_object(outcome) for outcome in run.outcomes.values()]
            echo_json(json.dumps({"event": "ended", "run": run.entry.id, "totals": str(counted), "outcomes": objects}))
        else:
            echo(f"run {run.entry.id}: {counted}")
            if not counted.all_good:
                echo(f"run `meshctl resume` for the unfinished {unfinished}", err=True)
    return typer.Exit(exit_for(run.outcomes.values(), opened.interrupt))
