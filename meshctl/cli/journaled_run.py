"""A run of any command: journal entry -> progress and signals while the block works -> totals in the journal and on
the screen -> exit code. Provisioning, bootstrap, restore and the robots' commands all use it.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING

import typer

from meshctl.cli.context import Session, exit_for, progress_for
from meshctl.cli.output import echo, echo_json, ignore_broken_pipe
from meshctl.errors import ExitCode, MeshctlError
from meshctl.fleet import Outcome, totals
from meshctl.fleet.journal import ROBOT_PREFIX, Run

if TYPE_CHECKING:
    from meshctl.apply.context import RunContext
    from meshctl.apply.station_flush import StationFlushes
    from meshctl.device.observation import Observation
    from meshctl.report.progress import RunProgress


@dataclass(slots=True)
class JournaledRun:
    """A run in progress; the block adds to `outcomes`."""

    entry: Run
    progress: RunProgress
    outcomes: dict[str, Outcome]


class NodesClaimed(MeshctlError):
    """Nodes that another operator's run is changing. Nothing was changed."""

    exit_code = ExitCode.FINDINGS


@contextmanager
def journaled_run(
    opened: Session,
    command: str,
    names: Sequence[str],
    *,
    changing: Sequence[str] | None = None,
    plan: str = "",
    as_json: bool,
) -> Iterator[JournaledRun]:
    """Record a run of `command` on the nodes or robots `names`; `changing` are those that it changes, by default all;
    `plan` is what `meshctl resume` needs.

    SIGINT, SIGTERM and SIGHUP within the block request a stop. The run ends in the journal in any case. Raises
    NodesClaimed, before the block, where operators share the journal and one of them is changing a node.
    """
    entry = opened.journal.begin(
        command, fleet=opened.fleet.name, inventory=opened.inventory, nodes=tuple(names), plan=plan
    )
    outcomes: dict[str, Outcome] = {}
    try:
        _claim(opened, entry, command, names if changing is None else changing)
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
    if opened.journal.notice:
        with ignore_broken_pipe():
            echo(opened.journal.notice, err=True)


def _claim(opened: Session, entry: Run, command: str, names: Sequence[str]) -> None:
    prefix = ROBOT_PREFIX if command.startswith("robots ") else ""
    taken = opened.journal.claim(entry.id, opened.fleet.name, [f"{prefix}{name}" for name in names])
    if not taken:
        return
    by_run: dict[tuple[int, str], list[str]] = {}
    for claim in taken:
        by_run.setdefault((claim.run, claim.owner), []).append(claim.node.removeprefix(prefix))
    text = "; ".join(
        f"{owner}{f' (run {run})' if run else ''} is changing {', '.join(nodes)}"
        for (run, owner), nodes in by_run.items()
    )
    raise NodesClaimed(
        f"nothing was changed: {text}",
        hint="wait until that run ends (`meshctl history --follow`), or exclude these nodes",
    )


def run_context(
    opened: Session,
    run: JournaledRun,
    flushes: StationFlushes,
    before: Mapping[str, Observation],
    *,
    observed: Mapping[str, Observation] = MappingProxyType({}),
    rate_bytes_per_s: float | None = None,
) -> RunContext:
    """The context that all nodes of a run share. The neighbors of the nodes in `seen` are observed first; `observed`
    holds observations already made."""
    from meshctl.apply.context import RunContext
    from meshctl.apply.neighbor_query import observe_neighbors
    from meshctl.apply.prepare import base_macs
    from meshctl.nodes.collect import known_macs

    fleet, known = opened.fleet, opened.journal.last_known(opened.fleet.name)
    observations = observe_neighbors(
        opened.access, fleet, before, known, observations=observed, interrupt=opened.interrupt
    )
    return RunContext(
        fleet,
        opened.access,
        opened.journal,
        run.entry,
        run.progress,
        opened.interrupt,
        opened.owner,
        flushes.listener,
        observations,
        known_macs(fleet, known),
        base_macs(fleet, observations, known),
        rate_bytes_per_s,
    )


# commands that are repeated with their arguments, as no other one takes them up
_WITH_ARGUMENTS = ("bootstrap", "restore", "replace")


def retry_hint(command: str, undoes: int | None = None) -> str:
    """The way to finish a run of `command`; `undoes` is the run that a rollback takes back."""
    if undoes is not None:
        return f"run `meshctl rollback {undoes}`"
    return f"repeat the same `meshctl {command}`" if command in _WITH_ARGUMENTS else "run `meshctl resume`"


def print_totals(
    opened: Session, run: JournaledRun, *, as_json: bool, unfinished: str = "nodes", retry: str = "run `meshctl resume`"
) -> typer.Exit:
    """Print the totals, with `as_json` as the event `ended`, and the hint `retry` if something is left; returns the
    exit to raise."""
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
                echo(f"{retry} for the unfinished {unfinished}", err=True)
    return typer.Exit(exit_for(run.outcomes.values(), opened.interrupt))
