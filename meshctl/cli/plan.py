"""`meshctl plan`, `apply`, `provision`, `resume`."""

from __future__ import annotations

import json
import time
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from meshctl.apply.prepare import PlanOptions
from meshctl.apply.resume import resolutions
from meshctl.cli.context import KeyFiles, Lab, Nodes, Session, session
from meshctl.cli.journaled_run import (
    ask_and_carry_out,
    carry_out_plan,
    checked,
    choices_of,
    prepared_for,
    show,
    write_text,
)
from meshctl.cli.options import AsJson, InventoryPath
from meshctl.cli.output import echo, echo_json
from meshctl.errors import ExitCode, InputError
from meshctl.fleet.journal import Journal, RunRecord
from meshctl.plan import Plan, Verdict
from meshctl.plan.saved import SavedPlan, as_agreed, dump, load

NoFirmware = Annotated[bool, typer.Option("--no-firmware", help="Leave the firmware as it is.")]
LeaveBehind = Annotated[
    str, typer.Option("--leave-behind", help="Nodes (a,b,...; or all) that may stay in the old cell of their mesh.")
]
AcceptCut = Annotated[
    str, typer.Option("--accept-cut", help="Cut vertices (a,b,...; or all) that may be flashed nevertheless.")
]
Brief = Annotated[
    bool, typer.Option("--brief/--full", help="Hide the files' diffs; the settings that change are named all the same.")
]
Yes = Annotated[bool, typer.Option("--yes", "-y", help="Do not ask.")]
Rate = Annotated[float | None, typer.Option("--rate", help="Upload at most so many kilobytes per second to a node.")]


def plan(
    nodes: Nodes = None,
    inventory: InventoryPath = Path(),
    out: Annotated[Path | None, typer.Option("--out", help="Save the plan, for `meshctl apply`.")] = None,
    no_firmware: NoFirmware = False,
    leave_behind: LeaveBehind = "",
    accept_cut: AcceptCut = "",
    brief: Brief = False,
    as_json: AsJson = False,
    key: KeyFiles = None,
    lab: Lab = None,
) -> None:
    """Show what provisioning would do to each node, in which order, and why. Changes nothing.

    Example: meshctl plan 'husky1-*' --out plan.json
    """
    choices = choices_of(no_firmware, leave_behind, accept_cut)
    with session(inventory, key_files=key or (), lab=lab) as opened:
        prepared = prepared_for(opened, nodes, choices)
        saved = SavedPlan(prepared.plan, prepared.salt, str(inventory), choices.with_firmware)
        if out is not None:
            write_text(out, dump(saved))
        if as_json:
            echo_json(dump(saved), nl=False)
        else:
            show(prepared.plan, opened.fleet, brief=brief)
        if prepared.plan.refusal:
            raise typer.Exit(ExitCode.FINDINGS)


def apply(
    plan_file: Annotated[Path, typer.Argument(help="A plan that `meshctl plan --out` wrote.")],
    inventory: InventoryPath = Path(),
    rate: Rate = None,
    as_json: AsJson = False,
    key: KeyFiles = None,
    lab: Lab = None,
) -> None:
    """Carry out a saved plan, exactly. Nodes that are not as they were when it was made are refused.

    Example: meshctl apply plan.json
    """
    try:
        text = plan_file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        what = error.strerror if isinstance(error, OSError) else error
        raise InputError(f"{plan_file}: cannot be read: {what}") from error
    saved = load(text, str(plan_file))
    with session(inventory, key_files=key or (), lab=lab) as opened:
        if saved.plan.fleet != opened.fleet.name:
            raise InputError(f"{plan_file}: a plan for fleet {saved.plan.fleet}, the inventory is {opened.fleet.name}")
        fresh = prepared_for(opened, list(saved.plan.nodes), PlanOptions(saved.with_firmware), saved.salt)
        agreed = replace(fresh, plan=as_agreed(saved.plan, fresh.plan))
        carry_out_plan(opened, agreed, "apply", saved.with_firmware, as_json=as_json, rate=rate)


def provision(
    nodes: Nodes = None,
    inventory: InventoryPath = Path(),
    check: Annotated[bool, typer.Option("--check", help="Change nothing; exit 1 if a node differs.")] = False,
    yes: Yes = False,
    no_firmware: NoFirmware = False,
    leave_behind: LeaveBehind = "",
    accept_cut: AcceptCut = "",
    rate: Rate = None,
    brief: Brief = False,
    as_json: AsJson = False,
    key: KeyFiles = None,
    lab: Lab = None,
) -> None:
    """Plan, ask, apply: bring nodes to what the inventory says, and never strand one.

    Example: meshctl provision 'b*' --leave-behind b07
    """
    choices = choices_of(no_firmware, leave_behind, accept_cut)
    with session(inventory, key_files=key or (), lab=lab) as opened:
        prepared = prepared_for(opened, nodes, choices)
        if check:
            raise typer.Exit(checked(prepared.plan, opened.fleet, as_json=as_json, brief=brief))
        ask_and_carry_out(opened, prepared, "provision", choices, yes=yes, as_json=as_json, brief=brief, rate=rate)


def resume(
    run: Annotated[int | None, typer.Argument(help="Number of the run; default: the last one that left work.")] = None,
    inventory: InventoryPath = Path(),
    yes: Yes = False,
    leave_behind: LeaveBehind = "",
    accept_cut: AcceptCut = "",
    rate: Rate = None,
    brief: Brief = False,
    as_json: AsJson = False,
    key: KeyFiles = None,
    lab: Lab = None,
) -> None:
    """Take up the nodes that an earlier run left: those that were off, failed, went back, or were never begun.

    Example: meshctl resume --yes
    """
    with session(inventory, key_files=key or (), lab=lab) as opened:
        record, left = _to_resume(opened.journal, opened.fleet.name, run)
        if record.command.startswith("robots "):
            from meshctl.cli.robots_work import take_up

            raise take_up(opened, inventory, record, as_json=as_json)
        if record.command == "restore":
            hint = f"`meshctl restore {' '.join(left)} FILE` again, or `meshctl provision` for what the inventory says"
            raise InputError(f"run {record.id} put a backup back, which the inventory does not know", hint=hint)
        names = _still_managed(opened, left)
        if not names:
            echo(f"run {record.id} left nothing to do", err=as_json)
            return
        if not as_json:
            echo(f"resuming run {record.id} ({record.command}): {', '.join(names)}")
        told = json.loads(record.plan).get("choices", {}) if record.plan else {}
        added = choices_of(False, leave_behind, accept_cut)
        choices = PlanOptions(
            bool(told.get("with_firmware", True)),
            (*told.get("leave_behind", ()), *added.leave_behind),
            (*told.get("accept_cuts", ()), *added.accept_cuts),
        )
        prepared = prepared_for(opened, names, choices)
        for line in bench_advice(record, prepared.plan):
            echo(line, err=True)
        for name, text in resolutions(record.id, opened.journal.outcomes(record.id), prepared).items():
            line = json.dumps({"event": "note", "node": name, "at_s": round(time.time(), 3), "text": text})
            echo(line if as_json else f"{name}: {text}")
        ask_and_carry_out(opened, prepared, "resume", choices, yes=yes, as_json=as_json, brief=brief, rate=rate)


def bench_advice(record: RunRecord, plan: Plan) -> tuple[str, ...]:
    """What to do about nodes that a run on the bench left and that do not answer: resume reaches them by the address
    that they may never have got."""
    silent = [node.node for node in plan.of(Verdict.AWAY)]
    if record.command not in ("bootstrap", "replace") or not silent:
        return ()
    return (
        f"run {record.id} was a {record.command}: {', '.join(silent)} may still be factory fresh",
        f"hint: plug in such a device on the bench and run `meshctl {record.command}` again",
    )


def _to_resume(journal: Journal, fleet: str, run_id: int | None) -> tuple[RunRecord, tuple[str, ...]]:
    """The run, and the nodes of it to take up."""
    left = journal.unfinished_runs(fleet)
    number = run_id if run_id is not None else next(iter(left), None)
    if number is None:
        latest = next(iter(journal.runs(fleet=fleet, limit=1)), None)
        if latest is None:
            raise InputError(f"there is no run of fleet {fleet} to resume", hint="`meshctl provision` begins one")
        return latest, ()
    record = journal.run(number)
    if record is None or (record.fleet, record.lab) != (fleet, journal.lab):
        raise InputError(f"there is no run {number} of fleet {fleet}", hint="`meshctl history` lists the runs")
    if not record.is_over:
        raise InputError(f"run {record.id} is still under way ({record.owner})", hint="wait for it, or interrupt it")
    return record, left.get(number, ()) if run_id is None else journal.unfinished(number)


def _still_managed(opened: Session, names: Iterable[str]) -> list[str]:
    """Those that the inventory still has; the others are told."""
    managed = {node.name for node in opened.fleet.managed()}
    wanted = list(names)
    if gone := [name for name in wanted if name not in managed]:
        echo(f"left out, since the inventory does not manage them any more: {', '.join(gone)}", err=True)
    return [name for name in wanted if name in managed]
