"""`meshctl history`: earlier runs from the journal; it needs neither an inventory nor a node."""

from __future__ import annotations

import json
import os
from datetime import datetime
from typing import Annotated, Any

import typer

from meshctl.cli.options import AsJson
from meshctl.errors import InputError
from meshctl.fleet.journal import Journal, RunRecord, default_path


def history(
    run: Annotated[int | None, typer.Argument(help="Number of a run, to see its nodes and steps.")] = None,
    node: Annotated[str | None, typer.Option("--node", help="Only this node: its runs, or its steps in a run.")] = None,
    limit: Annotated[int, typer.Option("--limit", "-n", min=1, help="How many runs to list.")] = 20,
    as_json: AsJson = False,
) -> None:
    """Show earlier runs; with a run's number its nodes, steps, outcomes and durations.

    Example: meshctl history 12 --node b03
    """
    with Journal(default_path(os.environ)) as journal:
        if run is None:
            _list_runs(journal, node, limit, as_json=as_json)
        else:
            _show_run(journal, run, node, as_json=as_json)


def _list_runs(journal: Journal, node: str | None, limit: int, *, as_json: bool) -> None:
    records = journal.runs(node=node, limit=limit)
    if as_json:
        typer.echo(json.dumps([_run_object(record) for record in records], indent=1))
        return
    for record in records:
        typer.echo(f"{record.id:>5}  {_moment(record.began_s)}  {record.command:<17} {record.fleet:<16} {record.state}")
        for outcome in journal.outcomes(record.id) if node is not None else ():
            if outcome.node == node:
                typer.echo(f"       {outcome}")
    if not records:
        typer.echo("no runs yet" if node is None else f"no runs of {node} yet")


def _show_run(journal: Journal, run_id: int, node: str | None, *, as_json: bool) -> None:
    record = journal.run(run_id)
    if record is None:
        raise InputError(f"there is no run {run_id}", hint="`meshctl history` lists the runs")
    outcomes = [outcome for outcome in journal.outcomes(run_id) if node in (None, outcome.node)]
    if not outcomes and node is not None:
        raise InputError(f"{node} had no part in run {run_id}", hint=f"`meshctl history {run_id}` shows who had")
    steps = journal.steps(run_id, node)
    if as_json:
        told = {
            **_run_object(record),
            "outcomes": [{"node": o.node, "result": o.result.value, "reason": o.reason} for o in outcomes],
            "steps": [
                {"node": s.node, "step": s.step, "began_s": s.began_s, "duration_s": s.duration_s, "result": s.result}
                for s in steps
            ],
        }
        typer.echo(json.dumps(told, indent=1))
        return
    typer.echo(f"run {record.id}: {record.command} of {record.fleet} by {record.owner}, {_moment(record.began_s)}")
    typer.echo(f"  {record.inventory}: {record.state}")
    width = max((len(step.step) for step in steps), default=0)
    for outcome in outcomes:
        typer.echo(f"{outcome}" + (f" ({outcome.duration_s:.1f} s)" if outcome.duration_s else ""))
        for step in steps:
            if step.node == outcome.node:
                took = "cut short" if step.duration_s is None else f"{step.duration_s:.2f} s"
                result = "" if step.result == "done" else step.result
                typer.echo(f"  {step.step:<{width}} {took:>10}  {result}".rstrip())


def _run_object(record: RunRecord) -> dict[str, Any]:
    return {
        "run": record.id,
        "command": record.command,
        "fleet": record.fleet,
        "inventory": record.inventory,
        "owner": record.owner,
        "began_s": record.began_s,
        "ended_s": record.ended_s,
        "state": record.state,
    }


def _moment(seconds: float) -> str:
    return datetime.fromtimestamp(seconds).astimezone().isoformat(sep=" ", timespec="seconds")
