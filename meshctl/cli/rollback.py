"""`meshctl rollback`: return nodes to their configuration from before a run."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated

import typer

from meshctl.apply.rollback import EarlierState, irreversible, without_undone
from meshctl.cli.context import (
    AsJson,
    DryRun,
    InventoryPath,
    KeyFiles,
    Lab,
    Limit,
    Nodes,
    Session,
    selected_nodes,
    session,
)
from meshctl.cli.output import echo
from meshctl.cli.plan import AcceptCut, Brief, Direct, LeaveBehind, Rate, Together, Yes
from meshctl.cli.plan_execution import PlanRefused, choices_of, confirm_and_execute, prepare_plan
from meshctl.cli.run_record import run_number, run_of
from meshctl.cli.site_files import with_states
from meshctl.cli.site_runs import RunOptions, change_everywhere, meet, sites_of
from meshctl.errors import ExitCode, InputError
from meshctl.fleet import Outcome, Result
from meshctl.fleet.journal import Journal, RunRecord
from meshctl.fleet.process import runs_here
from meshctl.fleet.run_files import BEFORE, RunFiles

# These apply the plan of an inventory, and record what they replace.
REVERSIBLE = ("provision", "apply", "resume", "rollback")
# Results after which the node may run another configuration than before.
_CHANGED = (Result.DONE, Result.UNCERTAIN, Result.FAILED)
_REASONS = {
    "bootstrap": "the nodes had factory defaults before: run `meshctl bootstrap` after a factory reset",
    "replace": "it gave the node another device",
    "restore": "it wrote a backup: run `meshctl restore` with another one, or `meshctl provision`",
}


def rollback(
    run: Annotated[str, typer.Argument(help="Run number, or `last`: the fleet's latest run but rollbacks.")],
    nodes: Nodes = None,
    limit: Limit = None,
    inventory: InventoryPath = Path(),
    dry_run: DryRun = False,
    yes: Yes = False,
    together: Together = False,
    leave_behind: LeaveBehind = None,
    accept_cut: AcceptCut = None,
    direct: Direct = False,
    rate: Rate = None,
    brief: Brief = False,
    as_json: AsJson = False,
    key: KeyFiles = None,
    lab: Lab = None,
) -> None:
    """Restore the configuration that nodes had before a run. Planned, confirmed and proven like `provision`.

    The inventory is not changed: revert your edit there, or the next `provision` applies it again.

    Example: meshctl rollback 12
    """
    with session(inventory, key_files=key or (), lab=lab, changes_nothing=dry_run) as opened:
        record = _record(opened, run)
        number = record.id
        selected = {node.name for node in selected_nodes(opened.fleet, nodes, limit)} if nodes or limit else None
        # how parts of it ended that were left to their sites
        meet(opened, record, as_json=as_json)
        states = _states(opened, record, selected, as_json=as_json)
        opened = with_states(opened, states)
        choices = choices_of(opened.fleet, True, leave_behind, accept_cut, together)
        own, sites = sites_of(opened, list(states), None, direct=direct)
        try:
            if sites:
                options = RunOptions("rollback", choices, as_json, rate, undoes=number)
                raise change_everywhere(opened, inventory, own, sites, options, yes=yes, brief=brief, dry_run=dry_run)
            prepared = prepare_plan(opened, own, choices, reconnects=not dry_run)
            confirm_and_execute(
                opened,
                prepared,
                "rollback",
                choices,
                yes=yes,
                as_json=as_json,
                brief=brief,
                rate=rate,
                dry_run=dry_run,
                undoes=number,
            )
        except typer.Exit as ended:
            if ended.exit_code == ExitCode.OK and not dry_run:
                text = (
                    f"the inventory still describes run {number}: revert it, or the next `meshctl provision` applies it"
                )
                echo(text, err=True)
            raise


def _record(opened: Session, run: str) -> RunRecord:
    """The run. Raises InputError for none of this fleet, PlanRefused for one that no plan takes back."""
    fleet = opened.fleet.name
    run_id = run_number(run, _latest(opened.journal, fleet))
    record = run_of(opened.journal, fleet, run_id)
    if record.command.startswith("robots "):
        raise PlanRefused(
            f"run {run_id} was `{record.command}`", hint="run `meshctl robots rollback` for the previous release"
        )
    if record.command not in REVERSIBLE:
        raise PlanRefused(
            f"run {run_id} was a {record.command} and cannot be rolled back: {_REASONS.get(record.command, '')}"
        )
    return record


def _latest(journal: Journal, fleet: str) -> Iterator[RunRecord]:
    """Newest first, without rollbacks: an interrupted one that is repeated must not be undone instead."""
    return (each for each in journal.runs(fleet=fleet, limit=None) if each.command != "rollback")


def _states(
    opened: Session, record: RunRecord, selected: set[str] | None, *, as_json: bool
) -> Mapping[str, EarlierState]:
    """The earlier state of each node that the run changed. Prints what cannot be taken back."""
    saved = RunFiles(opened.journal.path).load(record.id, BEFORE)
    if saved is None and not runs_here(record.process):
        raise PlanRefused(
            f"run {record.id} was {record.owner}'s: the files that it replaced are kept on that computer only",
            hint=f"run `meshctl rollback {record.id}` there",
        )
    saved = saved or {}
    later, undoing = _later_runs(opened, record)
    states: dict[str, EarlierState] = {}
    refused: dict[str, str] = {}
    for outcome in _changed_outcomes(opened, record.id, selected):
        name = outcome.node
        state = EarlierState.from_json(saved[name]) if name in saved else None
        node = opened.fleet.nodes.get(name)
        managed = node if node is not None and node.state.is_managed else None
        if why := irreversible(record.id, managed, outcome, state, later.get(name, ()), undoing):
            refused[name] = why
        elif state is not None:
            states[name] = state
    for name, why in refused.items():
        echo(f"{name}: cannot be rolled back: {why}", err=True)
    if not states:
        if refused:
            raise PlanRefused(f"run {record.id}: no node can be rolled back")
        raise InputError(f"run {record.id} changed none of these nodes", hint=f"see `meshctl history {record.id}`")
    if refused and not as_json:
        echo(f"rolling back the other {len(states)}: {', '.join(states)}")
    return states


def _changed_outcomes(opened: Session, run_id: int, selected: set[str] | None) -> list[Outcome]:
    return [
        outcome
        for outcome in opened.journal.outcomes(run_id)
        if outcome.result in _CHANGED and (selected is None or outcome.node in selected)
    ]


def _later_runs(opened: Session, record: RunRecord) -> tuple[dict[str, tuple[int, ...]], frozenset[int]]:
    """Node -> the later runs that changed it and are not undone, oldest first; and those that undid `record`."""
    undoing: set[int] = set()
    later: dict[str, list[tuple[int, int | None]]] = {}
    for each in reversed(opened.journal.runs(fleet=opened.fleet.name, limit=None)):
        if each.id <= record.id or each.command.startswith("robots "):
            continue
        undone = json.loads(each.plan).get("undoes") if each.plan else None
        if undone == record.id:
            undoing.add(each.id)
        for outcome in opened.journal.outcomes(each.id):
            if outcome.result in (Result.DONE, Result.UNCERTAIN):
                later.setdefault(outcome.node, []).append((each.id, undone))
    # the rollback of this very run leaves nothing to take back, so it counts
    return {name: without_undone(runs) for name, runs in later.items()}, frozenset(undoing)
