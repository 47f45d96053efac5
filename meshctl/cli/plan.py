"""`meshctl plan`, `apply`, `provision`, `resume`."""

from __future__ import annotations

import json
import time
from collections.abc import Collection, Iterable
from contextlib import closing
from pathlib import Path
from typing import Annotated

import typer

from meshctl.apply.prepare import PlanOptions
from meshctl.apply.resume import resolutions
from meshctl.cli.context import AsJson, DryRun, InventoryPath, KeyFiles, Lab, Limit, Nodes, Session, session
from meshctl.cli.output import echo, write_file
from meshctl.cli.plan_execution import (
    choices_of,
    confirm_and_execute,
    execute_plan,
    prepare_agreed,
    prepare_plan,
    report_check,
    report_plan,
    saved_plan,
)
from meshctl.cli.run_record import LAST, run_number, run_of
from meshctl.cli.saved_site_plans import SavedSitePlans, check_fleet, dump_site_plans, load_site_plans
from meshctl.cli.site_files import hand_over, with_sent_states
from meshctl.cli.site_runs import (
    RunOptions,
    change_everywhere,
    confirm_everywhere,
    execute_everywhere,
    meet,
    prepare_everywhere,
    prepare_saved,
    report_everywhere,
    sites_of,
)
from meshctl.errors import ExitCode, InputError
from meshctl.fleet.journal import Journal, RunRecord
from meshctl.plan import Plan, Verdict
from meshctl.plan.saved import dump, load

NoFirmware = Annotated[bool, typer.Option("--no-firmware", help="Do not upgrade firmware.")]
LeaveBehind = Annotated[
    list[str] | None,
    typer.Option(
        "--leave-behind",
        metavar="NODES",
        help="Nodes ('b07,role:beacon', @FILE, or all) that may be left in the old cell of their mesh.",
    ),
]
AcceptCut = Annotated[
    list[str] | None,
    typer.Option(
        "--accept-cut", metavar="NODES", help="Cut vertices ('b07,group:relays', @FILE, all) to flash anyway."
    ),
]
Together = Annotated[
    bool,
    typer.Option(
        "--together",
        help="Change all nodes of running meshes simultaneously; all roll back unless a quorum is healthy.",
    ),
]
Brief = Annotated[bool, typer.Option("--brief/--full", help="Hide file diffs.")]
Yes = Annotated[bool, typer.Option("--yes", "-y", help="Skip the confirmation.")]
Rate = Annotated[float | None, typer.Option("--rate", metavar="KB_S", help="Upload limit per node in kB/s.")]

# `provision` and `resume` reach such nodes before they plan; at a site they have the worker plan.
Reconnect = Annotated[
    bool,
    typer.Option("--reconnect", hidden=True, help="Let neighbors remove stale station entries of unreachable nodes."),
]
Direct = Annotated[
    bool, typer.Option("--direct", help="Connect to nodes of sites from here, instead of through their workers.")
]


def plan(
    nodes: Nodes = None,
    limit: Limit = None,
    inventory: InventoryPath = Path(),
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE", help="Save the plan for `meshctl apply`.")
    ] = None,
    no_firmware: NoFirmware = False,
    together: Together = False,
    leave_behind: LeaveBehind = None,
    accept_cut: AcceptCut = None,
    direct: Direct = False,
    reconnect: Reconnect = False,
    brief: Brief = False,
    as_json: AsJson = False,
    key: KeyFiles = None,
    lab: Lab = None,
) -> None:
    """Show what provisioning would change on each node, in which order, and why. Changes nothing.

    Exit code: 1 if a node or the whole plan is refused, otherwise 0; run `provision --check` to see if a node differs.

    Example: meshctl plan 'husky1-*' --out plan.json
    """
    with session(inventory, key_files=key or (), lab=lab, changes_nothing=True) as opened:
        choices = choices_of(opened.fleet, no_firmware, leave_behind, accept_cut, together)
        own, sites = sites_of(opened, nodes, limit, direct=direct)
        if sites:
            with closing(prepare_everywhere(opened, inventory, own, sites, choices)) as made:
                if out is not None:
                    write_file(out, dump_site_plans(made.saved(opened, choices)), inventory=opened.fleet.files)
                raise typer.Exit(report_everywhere(opened, made, choices, as_json=as_json, brief=brief))
        opened = with_sent_states(opened)
        prepared = prepare_plan(opened, own, choices, reconnects=reconnect)
        hand_over(prepared)
        if out is not None:
            write_file(out, dump(saved_plan(opened, prepared, choices)), inventory=opened.fleet.files)
        raise typer.Exit(report_plan(opened, prepared, choices, as_json=as_json, brief=brief))


def apply(
    plan_file: Annotated[Path, typer.Argument(help="Plan written by `meshctl plan --out`.")],
    inventory: InventoryPath = Path(),
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Ignored: apply never asks.", hidden=True)] = False,
    dry_run: DryRun = False,
    rate: Rate = None,
    reconnect: Reconnect = False,
    as_json: AsJson = False,
    key: KeyFiles = None,
    lab: Lab = None,
) -> None:
    """Apply a saved plan, without asking for confirmation. Nodes that have changed since then are refused.

    Example: meshctl apply plan.json
    """
    try:
        text = plan_file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        what = error.strerror if isinstance(error, OSError) else error
        raise InputError(f"cannot read {plan_file}: {what}") from error
    everywhere = load_site_plans(text, str(plan_file))
    if everywhere is not None:
        with session(inventory, key_files=key or (), lab=lab, changes_nothing=dry_run) as opened:
            options = RunOptions("apply", PlanOptions(everywhere.with_firmware), as_json, rate)
            raise _apply_everywhere(opened, inventory, everywhere, str(plan_file), options, dry_run=dry_run)
    saved = load(text, str(plan_file))
    with session(inventory, key_files=key or (), lab=lab, changes_nothing=dry_run) as opened:
        check_fleet(saved.plan.fleet, opened.fleet, str(plan_file))
        opened = with_sent_states(opened)
        agreed = prepare_agreed(opened, saved, reconnects=reconnect or not dry_run)
        if dry_run:
            hand_over(agreed)
            choices = PlanOptions(saved.with_firmware)
            raise typer.Exit(report_plan(opened, agreed, choices, as_json=as_json, brief=False))
        execute_plan(opened, agreed, "apply", saved.with_firmware, as_json=as_json, rate=rate)


def _apply_everywhere(
    opened: Session, inventory: Path, saved: SavedSitePlans, file: str, options: RunOptions, *, dry_run: bool
) -> typer.Exit:
    with closing(prepare_saved(opened, inventory, saved, file, reconnects=not dry_run)) as made:
        if dry_run:
            return typer.Exit(report_everywhere(opened, made, options.choices, as_json=options.as_json, brief=False))
        confirm_everywhere(opened, made, yes=True)
        return execute_everywhere(opened, made, options)


def provision(
    nodes: Nodes = None,
    limit: Limit = None,
    inventory: InventoryPath = Path(),
    check: Annotated[bool, typer.Option("--check", help="Change nothing; exit with 1 if a node differs.")] = False,
    dry_run: DryRun = False,
    yes: Yes = False,
    no_firmware: NoFirmware = False,
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
    """Plan, confirm and apply: bring nodes to the state in the inventory without losing contact to any.

    Example: meshctl provision 'b*' --together
    """
    with session(inventory, key_files=key or (), lab=lab, changes_nothing=check or dry_run) as opened:
        choices = choices_of(opened.fleet, no_firmware, leave_behind, accept_cut, together)
        own, sites = sites_of(opened, nodes, limit, direct=direct)
        if sites:
            options = RunOptions("provision", choices, as_json, rate)
            raise change_everywhere(
                opened, inventory, own, sites, options, yes=yes, brief=brief, dry_run=dry_run, check=check
            )
        prepared = prepare_plan(opened, own, choices, reconnects=not check and not dry_run)
        if check:
            raise typer.Exit(report_check(prepared.plan, opened.fleet, as_json=as_json, brief=brief))
        confirm_and_execute(
            opened, prepared, "provision", choices, yes=yes, as_json=as_json, brief=brief, rate=rate, dry_run=dry_run
        )


def resume(
    run: Annotated[
        str | None, typer.Argument(help="Run number, or `last`: the latest unfinished run, as by default.")
    ] = None,
    inventory: InventoryPath = Path(),
    dry_run: DryRun = False,
    yes: Yes = False,
    together: Annotated[
        bool | None,
        typer.Option(
            "--together/--in-order",
            help="All nodes simultaneously, or stage by stage; default: as in the original run.",
        ),
    ] = None,
    leave_behind: LeaveBehind = None,
    accept_cut: AcceptCut = None,
    direct: Direct = False,
    rate: Rate = None,
    brief: Brief = False,
    as_json: AsJson = False,
    key: KeyFiles = None,
    lab: Lab = None,
) -> None:
    """Resume an interrupted run: the nodes that were unreachable, failed, rolled back or not started.

    Example: meshctl resume --yes
    """
    with session(inventory, key_files=key or (), lab=lab, changes_nothing=dry_run) as opened:
        record, left = _to_resume(opened.journal, opened.fleet.name, run)
        if record.command.startswith("robots "):
            from meshctl.cli.robots_context import resume_run

            if dry_run:
                raise InputError(
                    f"run {record.id} was `{record.command}` of {', '.join(left)}: --dry-run is for runs of radios",
                    hint="run `meshctl robots diff` to see what a deploy would change",
                )
            raise resume_run(opened, inventory, record, as_json=as_json)
        if record.command == "restore" and left:
            hint = f"run `meshctl restore {' '.join(left)} FILE` again, or `meshctl provision` to apply the inventory"
            raise InputError(f"run {record.id} restored a backup, which cannot be resumed", hint=hint)
        unknown = meet(opened, record, as_json=as_json)
        if unknown is not None:
            left = opened.journal.unfinished(record.id)
        if record.command == "rollback" and left:
            hint = "run `meshctl rollback` again with the number of the run to undo, or `meshctl provision`"
            raise InputError(f"run {record.id} was a rollback, which cannot be resumed", hint=hint)
        names = _still_managed(opened, [name for name in left if name not in (unknown or ())])
        if unknown:
            # another order could change them beside the run that may still be in progress
            echo(f"left out, until their sites report how run {record.id} ended: {', '.join(unknown)}", err=True)
            echo(f"hint: run `meshctl resume {record.id}` later, or `meshctl provision` for a new run", err=True)
        if not names:
            if unknown:
                raise typer.Exit(ExitCode.UNREACHABLE)
            echo(f"run {record.id} is finished: nothing to resume", err=as_json)
            return
        if not as_json:
            echo(f"resuming run {record.id} ({record.command}): {', '.join(names)}")
        written = json.loads(record.plan) if record.plan else {}
        recorded, origin = written.get("choices", {}), written.get("origin", record.command)
        added = choices_of(opened.fleet, False, leave_behind, accept_cut)
        choices = PlanOptions(
            bool(recorded.get("with_firmware", True)),
            (*recorded.get("leave_behind", ()), *added.leave_behind),
            (*recorded.get("accept_cuts", ()), *added.accept_cuts),
            together=bool(recorded.get("together", False)) if together is None else together,
        )
        own, sites = sites_of(opened, names, None, direct=direct)
        if sites:
            options = RunOptions("resume", choices, as_json, rate)
            ended = change_everywhere(opened, inventory, own, sites, options, yes=yes, brief=brief, dry_run=dry_run)
            raise _ended_without(unknown, ended)
        prepared = prepare_plan(opened, names, choices, reconnects=not dry_run)
        for line in bench_advice(record.id, origin, prepared.plan):
            echo(line, err=True)
        for name, text in resolutions(record.id, opened.journal.outcomes(record.id), prepared).items():
            line = json.dumps({"event": "note", "node": name, "at_s": round(time.time(), 3), "text": text})
            echo(line if as_json else f"{name}: {text}")
        try:
            confirm_and_execute(
                opened,
                prepared,
                "resume",
                choices,
                yes=yes,
                as_json=as_json,
                brief=brief,
                rate=rate,
                dry_run=dry_run,
                origin=origin,
            )
        except typer.Exit as exited:
            raise _ended_without(unknown, exited) from None


def _ended_without(unknown: Collection[str] | None, ended: typer.Exit) -> typer.Exit:
    """No success while nodes were left out."""
    return typer.Exit(ExitCode.UNREACHABLE) if unknown and ended.exit_code == ExitCode.OK else ended


def bench_advice(run: int, command: str, plan: Plan) -> tuple[str, ...]:
    """Advice for a replacement, which resume does not record in the inventory, and for unreachable nodes of a
    bootstrap: resume uses their inventory address, which they may not have yet. `command` is that of the run, or of
    the first one that it resumed."""
    unreachable = [node.node for node in plan.of(Verdict.AWAY)]
    if command == "replace" and not unreachable:
        return (f"hint: run the same `meshctl replace {' '.join(plan.nodes)} NEW` again to record it in the inventory",)
    if command not in ("bootstrap", "replace") or not unreachable:
        return ()
    return (
        f"run {run} was a {command}: {', '.join(unreachable)} may still have factory defaults",
        f"hint: connect such a device on the bench and run `meshctl {command}` again",
    )


def _to_resume(journal: Journal, fleet: str, run: str | None) -> tuple[RunRecord, tuple[str, ...]]:
    """The run to resume, and its unfinished nodes."""
    if run not in (None, LAST):
        record = run_of(journal, fleet, run_number(run, ()))
        return record, journal.unfinished(record.id)
    left = journal.unfinished_runs(fleet)
    number = next(iter(left), None)
    if number is None:
        latest = next(iter(journal.runs(fleet=fleet, limit=1)), None)
        if latest is None:
            raise InputError(f"fleet {fleet} has no run to resume", hint="start one with `meshctl provision`")
        return latest, ()
    return run_of(journal, fleet, number), left[number]


def _still_managed(opened: Session, names: Iterable[str]) -> list[str]:
    """The nodes that are still managed; prints a warning for the others."""
    managed = {node.name for node in opened.fleet.managed()}
    wanted = list(names)
    if gone := [name for name in wanted if name not in managed]:
        echo(f"skipping nodes that the inventory no longer manages: {', '.join(gone)}", err=True)
    return [name for name in wanted if name in managed]
