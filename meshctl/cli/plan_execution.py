"""Prepare and show a plan; execute a confirmed plan, journal it, print the summary and exit."""

from __future__ import annotations

import json
import secrets
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

import typer

from meshctl.apply.executor import assign_slots, execute, unflushed_since
from meshctl.apply.prepare import PlanOptions, Prepared, prepare
from meshctl.apply.station_flush import StationFlushes
from meshctl.cli.context import Session, confirm, line_width, selected_nodes
from meshctl.cli.journaled_run import JournaledRun, journaled_run, print_totals, retry_hint, run_context
from meshctl.cli.output import console, echo_json
from meshctl.cli.query_line import query_line
from meshctl.cli.site_files import replaced_by, runs_at_site
from meshctl.errors import ExitCode, MeshctlError
from meshctl.fleet import Outcome
from meshctl.fleet.run_files import BEFORE, CHANGES, RunFiles
from meshctl.model import Fleet
from meshctl.plan import NodePlan, Plan, Verdict
from meshctl.plan.saved import SavedPlan, as_agreed, dump
from meshctl.plan.switch import ALL

# Bytes of salt for a plan's fingerprints, as in RFC 7914.
SALT_BYTES = 16
# Node -> what becomes of it, and why.
Verdicts = Mapping[str, tuple[Verdict, str]]
OnOutcomes = Callable[[Mapping[str, Outcome]], None]


def ignore_outcomes(outcomes: Mapping[str, Outcome]) -> None:
    """For commands with nothing left to do after a run."""


class PlanRefused(MeshctlError):
    """A plan that meshctl refuses to execute."""

    exit_code = ExitCode.FINDINGS


def choices_of(
    fleet: Fleet,
    no_firmware: bool,
    leave_behind: Sequence[str] | None,
    accept_cut: Sequence[str] | None,
    together: bool = False,
) -> PlanOptions:
    """Raises InputError for a word that selects no node."""
    left, cut = (_acknowledged(fleet, given or ()) for given in (leave_behind, accept_cut))
    return PlanOptions(not no_firmware, left, cut, together=together)


def _acknowledged(fleet: Fleet, given: Sequence[str]) -> tuple[str, ...]:
    """The nodes that an option selects, however often it is given, or `all`."""
    words = tuple(part.strip() for text in given for part in text.split(",") if part.strip())
    if not words or ALL in words or runs_at_site():
        # a site gets names, also those of other sites, which its part of the inventory may lack
        return (ALL,) if ALL in words else words
    return tuple(node.name for node in selected_nodes(fleet, words, with_unmanaged=True))


def prepare_plan(
    opened: Session,
    nodes: list[str] | None,
    choices: PlanOptions,
    salt: bytes | None = None,
    *,
    limits: list[str] | None = None,
    reconnects: bool = False,
) -> Prepared:
    with query_line() as line, opened.interrupt.on_signals(line.print_above, is_only_reading=True):
        prepared = prepare(
            opened.renderer,
            opened.access,
            selected_nodes(opened.fleet, nodes, limits),
            opened.journal,
            salt=salt or secrets.token_bytes(SALT_BYTES),
            owner=opened.owner,
            choices=choices,
            interrupt=opened.interrupt,
            observer=line,
            reconnects=reconnects,
        )
    if opened.interrupt.stopping:
        raise KeyboardInterrupt
    return prepared


def saved_plan(opened: Session, prepared: Prepared, choices: PlanOptions) -> SavedPlan:
    return SavedPlan(prepared.plan, prepared.salt, opened.inventory, choices.with_firmware)


def prepare_agreed(opened: Session, saved: SavedPlan, *, reconnects: bool) -> Prepared:
    """The part of a saved plan that still applies."""
    fresh = prepare_plan(
        opened, list(saved.plan.nodes), PlanOptions(saved.with_firmware), saved.salt, reconnects=reconnects
    )
    return replace(fresh, plan=as_agreed(saved.plan, fresh.plan))


def show(plan: Plan, fleet: Fleet, *, brief: bool) -> None:
    from rich.text import Text

    from meshctl.report.plan_text import plan_lines

    out = console()
    for line in plan_lines(plan, with_diffs=not brief, width=line_width(), order=fleet.nodes):
        out.print(Text(line.text, line.style), soft_wrap=True)


def report_plan(opened: Session, prepared: Prepared, choices: PlanOptions, *, as_json: bool, brief: bool) -> ExitCode:
    """Print the plan; with `as_json`, as a saved plan. FINDINGS if it, or one of its nodes, is refused."""
    if as_json:
        echo_json(dump(saved_plan(opened, prepared, choices)), nl=False)
    else:
        show(prepared.plan, opened.fleet, brief=brief)
    return plan_code(prepared.plan)


def plan_code(plan: Plan) -> ExitCode:
    """FINDINGS if the plan, or one of its nodes, is refused."""
    return ExitCode.FINDINGS if plan.refusal or plan.of(Verdict.REFUSED) else ExitCode.OK


def report_check(plan: Plan, fleet: Fleet, *, as_json: bool, brief: bool) -> ExitCode:
    verdicts = {name: (node.verdict, node.reason) for name, node in plan.nodes.items()}
    if as_json:
        print_verdicts(plan.fleet, verdicts)
    else:
        show(plan, fleet, brief=brief)
    return check_code(verdicts)


def print_verdicts(fleet: str, verdicts: Verdicts) -> None:
    nodes = {name: {"verdict": verdict.value, "reason": reason} for name, (verdict, reason) in verdicts.items()}
    echo_json(json.dumps({"fleet": fleet, "nodes": nodes}, indent=1))


def check_code(verdicts: Verdicts) -> ExitCode:
    """The exit code of `provision --check`."""
    found = {verdict for verdict, _ in verdicts.values()}
    if found & {Verdict.CHANGE, Verdict.REFUSED}:
        return ExitCode.FINDINGS
    return ExitCode.UNREACHABLE if Verdict.AWAY in found else ExitCode.OK


def confirm_and_execute(
    opened: Session,
    prepared: Prepared,
    command: str,
    choices: PlanOptions,
    *,
    yes: bool,
    as_json: bool,
    brief: bool,
    rate: float | None,
    dry_run: bool = False,
    undoes: int | None = None,
    origin: str = "",
    on_outcomes: OnOutcomes = ignore_outcomes,
) -> None:
    """Show the plan, ask, execute it and exit; `undoes` is the run that a rollback takes back, `origin` and
    `on_outcomes` as for `execute_plan`."""
    from meshctl.report.plan_text import question

    if dry_run:
        raise typer.Exit(report_plan(opened, prepared, choices, as_json=as_json, brief=brief))
    if not as_json:
        # the refusal is the error below
        show(replace(prepared.plan, refusal="", refusal_hint=""), opened.fleet, brief=brief)
    if not prepared.plan.is_empty and not prepared.plan.refusal and not yes:
        confirm(question(prepared.plan))
    execute_plan(
        opened,
        prepared,
        command,
        choices.with_firmware,
        as_json=as_json,
        rate=rate,
        choices=choices,
        undoes=undoes,
        origin=origin,
        on_outcomes=on_outcomes,
    )


def save_before(opened: Session, run: JournaledRun, changing: Iterable[NodePlan], replaced: Mapping[str, Any]) -> None:
    """Save what the run changes, and what it replaces, for `history` and `rollback`; at a site only the former, since
    the latter has the nodes' keys."""
    files = RunFiles(opened.journal.path)
    changes = {node.node: [[each.path, each.kind, each.diff] for each in node.files] for node in changing}
    try:
        files.discard(run.entry.id)
        files.save(run.entry.id, CHANGES, changes)
        if not runs_at_site():
            files.save(run.entry.id, BEFORE, replaced)
    except MeshctlError as error:
        # a full disk must not prevent the run
        run.progress.stopping(f"{error}: `meshctl rollback {run.entry.id}` will not be possible")


def execute_plan(
    opened: Session,
    prepared: Prepared,
    command: str,
    with_firmware: bool,
    *,
    as_json: bool,
    rate: float | None,
    choices: PlanOptions | None = None,
    undoes: int | None = None,
    origin: str = "",
    on_outcomes: OnOutcomes = ignore_outcomes,
) -> None:
    """Execute the plan, journal it, print the totals, exit. `origin` is the command of the run that it resumes.
    `on_outcomes` gets the outcomes before the totals are printed: the exit code alone does not tell what
    became of a node, for example after Ctrl-C."""
    plan = prepared.plan
    if plan.refusal:
        raise PlanRefused(plan.refusal, hint=plan.refusal_hint)
    choices = choices or PlanOptions(with_firmware)
    stages = [[stage.kind.value, *stage.nodes] for stage in plan.stages]
    recorded = json.dumps(
        {"choices": asdict(choices), "stages": stages, **({} if undoes is None else {"undoes": undoes})}
        | ({"origin": origin} if origin else {})
    )
    changing = plan.of(Verdict.CHANGE)
    names = [node.node for node in changing]
    with journaled_run(opened, command, tuple(plan.nodes), changing=names, plan=recorded, as_json=as_json) as run:
        save_before(opened, run, changing, replaced_by(prepared))
        run.outcomes.update(execute_direct(opened, run, prepared, rate=rate))
        on_outcomes(run.outcomes)
    raise print_totals(opened, run, as_json=as_json, retry=bench_retry(origin, plan) or retry_hint(command, undoes))


def bench_retry(origin: str, plan: Plan) -> str:
    """The way to finish a resumed bootstrap whose nodes are all unreachable, in place of another `meshctl resume`."""
    away = [node.node for node in plan.of(Verdict.AWAY)]
    return f"run `meshctl bootstrap {' '.join(away)}`" if origin == "bootstrap" and len(away) == len(plan.nodes) else ""


def execute_direct(opened: Session, run: JournaledRun, prepared: Prepared, *, rate: float | None) -> dict[str, Outcome]:
    """Execute a plan whose nodes this process changes itself; `rate` is the upload limit per node in kB/s."""
    assign_slots(prepared, opened.access)
    observations, flushes = prepared.observed.observations, StationFlushes()
    unflushed = unflushed_since(prepared, opened.journal)
    context = run_context(
        opened,
        run,
        flushes,
        {name: observations[name] for name in unflushed},
        observed={**observations, **prepared.neighbor_observations},
        rate_bytes_per_s=None if rate is None else rate * 1000,
    )
    return execute(prepared, context, flushes, unflushed)
