"""`meshctl backup` and `meshctl restore`: save a node's whole state and restore it."""

from __future__ import annotations

import json
import os
import time
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from meshctl.apply.backup import (
    Backup,
    departure,
    differing_files,
    fetch,
    incompatibility,
    lockout_by,
    read_backup,
    restore_backup,
    uninstalled_packages,
    without_wireless,
)
from meshctl.apply.context import NodeContext
from meshctl.apply.health_checks import Expectation
from meshctl.apply.reconnect import open_repaired
from meshctl.apply.station_flush import UNFLUSHED, StationFlushes
from meshctl.cli.context import (
    AsJson,
    DryRun,
    InventoryPath,
    KeyFiles,
    Lab,
    Limit,
    Nodes,
    Session,
    confirm,
    exit_for,
    progress_for,
    selected_node,
    selected_nodes,
    session,
)
from meshctl.cli.journaled_run import JournaledRun, journaled_run, print_totals, retry_hint, run_context
from meshctl.cli.node_completion import complete_node
from meshctl.cli.output import echo, echo_json
from meshctl.cli.plan import Yes
from meshctl.cli.plan_execution import PlanRefused
from meshctl.device.observation import Observation
from meshctl.errors import InputError
from meshctl.fleet import Outcome, Result, run
from meshctl.model import Node
from meshctl.nodes.collect import collect, facts_of
from meshctl.nodes.dead_changes import observe_cleared
from meshctl.nodes.slots import nodes_in_work, transfers_at_once
from meshctl.plan import Cut, Effect, NodePlan, Verdict
from meshctl.wording import counted

_TO_ANOTHER_CELL = (
    "restore the rest with `--keep-radios`; a whole mesh changes its cell by the inventory and `meshctl provision`"
)


def backup(
    nodes: Nodes = None,
    limit: Limit = None,
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Directory for the NODE-TIME.tgz files.")] = Path(
        "backups"
    ),
    inventory: InventoryPath = Path(),
    as_json: AsJson = False,
    key: KeyFiles = None,
    lab: Lab = None,
) -> None:
    """Back up nodes: configuration, keys and accounts. Backups contain secrets and have mode 0600.

    Example: meshctl backup 'husky*' --out backups
    """
    with session(inventory, key_files=key or (), lab=lab, changes_nothing=True) as opened:
        selected = {node.name: node for node in selected_nodes(opened.fleet, nodes, limit)}
        try:
            out.mkdir(parents=True, exist_ok=True, mode=0o700)
        except OSError as error:
            raise InputError(f"cannot create {out}: {error.strerror}") from error

        def work(name: str) -> Outcome:
            with opened.access.borrow(selected[name]) as connection:
                observation = seen.get(name) or observe_cleared(connection, (), opened.interrupt)
                data = fetch(connection, name, observation)
            path = out / f"{name}-{time.strftime('%Y%m%dT%H%M%SZ', time.gmtime(observation.answered_at_s))}.tgz"
            _write_private(path, data)
            opened.journal.remember(opened.fleet.name, name, facts_of(observation), observation.answered_at_s)
            return Outcome(name, Result.DONE, str(path))

        with (
            progress_for(len(selected), as_json=as_json) as progress,
            opened.interrupt.on_signals(progress.stopping),
        ):
            # of all before the first transfer: changes of a killed meshctl end in the order that keeps nodes reachable
            parallel = nodes_in_work(opened.fleet.apply.parallel)
            seen = collect(opened.access, selected.values(), parallel=parallel, interrupt=opened.interrupt).observations
            ended = run(
                selected,
                work,
                parallel=transfers_at_once(opened.fleet.apply.parallel),
                interrupt=opened.interrupt,
                observer=progress,
            )
        raise typer.Exit(exit_for(ended.values(), opened.interrupt))


def _write_private(path: Path, data: bytes) -> None:
    # an incomplete file must not look like a backup
    part = path.with_name(f".{path.name}.part")
    try:
        with open(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)
    except OSError as error:
        part.unlink(missing_ok=True)
        raise InputError(f"cannot write {path}: {error.strerror}") from error


def restore(
    node: Annotated[str, typer.Argument(help="Node to restore.", autocompletion=complete_node)],
    file: Annotated[Path, typer.Argument(help="Backup written by `meshctl backup`.")],
    inventory: InventoryPath = Path(),
    keep_radios: Annotated[
        bool, typer.Option("--keep-radios", help="Leave /etc/config/wireless as it is: the node stays in its mesh.")
    ] = False,
    dry_run: DryRun = False,
    yes: Yes = False,
    as_json: AsJson = False,
    key: KeyFiles = None,
    lab: Lab = None,
) -> None:
    """Restore a node from a backup. The node rolls back unless it stays reachable, as for every change.

    Example: meshctl restore b03 backups/b03-20260701T090000Z.tgz
    """
    try:
        saved = read_backup(file.read_bytes(), str(file))
    except OSError as error:
        raise InputError(f"cannot read {file}: {error.strerror}") from error
    if keep_radios:
        saved = without_wireless(saved)
    with session(inventory, key_files=key or (), lab=lab) as opened:
        there = selected_node(opened.fleet, node)
        if dry_run:
            _show_restore(opened, there, saved, as_json=as_json)
            return
        if not yes:
            taken = time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime(saved.taken_s))
            confirm(f"Restore {there.name} to its state of {taken}?")
        journaled = _restore(opened, there.name, saved, as_json=as_json)
        raise print_totals(opened, journaled, as_json=as_json, retry=retry_hint("restore"))


def _show_restore(opened: Session, node: Node, saved: Backup, *, as_json: bool) -> None:
    """Print what a restore would change. Raises PlanRefused as the restore would."""
    with opened.access.borrow(node) as connection:
        observation = observe_cleared(connection, (), opened.interrupt)
        _require_restorable(opened, node, saved, observation)
        paths = differing_files(saved, observation, connection)
    missing = uninstalled_packages(saved, observation)
    if as_json:
        report = {"node": node.name, "files": paths, "uninstalled_packages": missing, "disabled": saved.disabled}
        echo_json(json.dumps(report, indent=1))
        return
    echo(f"{node.name}: {counted(len(paths), 'file')} would change" if paths else f"{node.name}: matches the backup")
    for path in paths:
        echo(f"  {path}")
    for package in missing:
        echo(f"  package {package} is in the backup but no longer installed")


def _require_restorable(opened: Session, node: Node, saved: Backup, observation: Observation) -> None:
    """Raises PlanRefused for a backup of another device, or one that would lock us out or leave the mesh."""
    if problem := incompatibility(saved, node.name, observation):
        raise PlanRefused(problem)
    if problem := departure(saved, node.name, observation):
        raise PlanRefused(problem, hint=_TO_ANOTHER_CELL)
    lockout = lockout_by(saved, node, opened.access.own_keys(node))
    if lockout is not None:
        raise PlanRefused(lockout.reason, hint=lockout.hint)


def _restore(opened: Session, name: str, saved: Backup, *, as_json: bool) -> JournaledRun:
    with journaled_run(opened, "restore", [name], as_json=as_json) as journaled:

        def work(_: str) -> Outcome:
            return _restore_node(opened, journaled, opened.fleet.nodes[name], saved)

        ended = run([name], work, parallel=1, interrupt=opened.interrupt, observer=journaled.progress)
        journaled.outcomes.update(ended)
        journaled.entry.finish_node(journaled.outcomes[name])
    return journaled


def _restore_node(opened: Session, journaled: JournaledRun, node: Node, saved: Backup) -> Outcome:
    flushes = StationFlushes()
    known = opened.journal.last_known(opened.fleet.name)
    connection, notes = open_repaired(
        opened.access, opened.fleet, node, known, interrupt=opened.interrupt, observer=journaled.progress
    )
    try:
        observation = observe_cleared(connection, (), opened.interrupt)
        _require_restorable(opened, node, saved, observation)
        ctx = _context(opened, journaled, node, observation, flushes)
        for note in notes:
            ctx.run.note(note, node.name)
        for package in uninstalled_packages(saved, observation):
            ctx.run.note(f"package {package} is in the backup but no longer installed", node.name)
        if saved.disabled:
            ctx.run.note(f"services disabled in the backup, left unchanged: {', '.join(saved.disabled)}", node.name)
    except BaseException:
        connection.close()
        raise
    outcome = restore_backup(ctx, connection, saved)
    unflushed = flushes.retry_unanswered(ctx.run).get(node.name, ())
    return replace(outcome, facts={UNFLUSHED: " ".join(unflushed)}) if unflushed else outcome


def _context(
    opened: Session, journaled: JournaledRun, node: Node, observation: Observation, flushes: StationFlushes
) -> NodeContext:
    """The context of a node to be restored, once its neighbors were observed."""
    shared = run_context(opened, journaled, flushes, {node.name: observation})
    plan = NodePlan(node.name, Verdict.CHANGE, effects=(Effect("everything", Cut.MESH, "restored"),))
    return NodeContext(shared, node, plan, opened.renderer.desired(node, observation), observation, Expectation())
