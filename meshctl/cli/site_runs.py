"""Provision nodes of sites, and others, in one command: plan everywhere -> show -> confirm -> execute everywhere.

The operator's own nodes (`direct`) are planned and changed here, the others by the workers of their sites, at the same
time, in one run of the journal. `meet` finds out how the sites' parts of an earlier run ended.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import typer

from meshctl.apply.executor import unchanged_outcome
from meshctl.apply.prepare import PlanOptions, Prepared
from meshctl.apply.rollback import EarlierStates
from meshctl.cli.context import Session, confirm, progress_for, selected_nodes
from meshctl.cli.journaled_run import JournaledRun, journaled_run, print_totals, retry_hint
from meshctl.cli.output import echo, echo_error, echo_json
from meshctl.cli.plan_execution import (
    PlanRefused,
    check_code,
    execute_direct,
    plan_code,
    prepare_agreed,
    prepare_plan,
    print_verdicts,
    save_before,
    saved_plan,
    show,
)
from meshctl.cli.saved_site_plans import SavedSitePlans, Unplanned, check_placement, dump_site_plans
from meshctl.cli.site_files import replaced_by
from meshctl.cli.site_orders import LateReplaced, expiry, signed_order
from meshctl.errors import ExitCode, InputError, MeshctlError, Unreachable
from meshctl.fleet import Event, EventKind, Outcome, Result, totals
from meshctl.fleet.journal import Run, RunRecord
from meshctl.plan import NodePlan, Plan, Verdict
from meshctl.plan.saved import dump
from meshctl.sites.bundle import SiteBundle, site_bundle
from meshctl.sites.dispatch import SiteExecution, SitePlan, SiteRun, by_site, prepare_sites
from meshctl.sites.envelope import ReplyKey
from meshctl.wording import counted


@dataclass(frozen=True, slots=True)
class RunOptions:
    """The options of one command that its execution needs."""

    command: str
    choices: PlanOptions
    as_json: bool
    rate_kb_s: float | None = None
    # the run that a rollback takes back
    undoes: int | None = None


@dataclass(frozen=True, slots=True)
class WholePlan:
    """The plans of one command: that of the operator's own nodes, if there are any, and those of the sites."""

    direct: Prepared | None
    sites: tuple[SitePlan, ...]

    @property
    def plans(self) -> tuple[Plan, ...]:
        made = [site.saved.plan for site in self.sites if site.saved is not None]
        return (*((self.direct.plan,) if self.direct is not None else ()), *made)

    @property
    def refusal(self) -> Plan | None:
        """The refused plan because of which nothing can be done: that of the operator's own nodes, or the first if all
        are refused."""
        refused = [plan for plan in self.plans if plan.refusal]
        is_own = self.direct is not None and bool(self.direct.plan.refusal)
        return refused[0] if refused and (is_own or len(refused) == len(self.plans)) else None

    @property
    def names(self) -> tuple[str, ...]:
        direct = () if self.direct is None else tuple(self.direct.plan.nodes)
        return (*direct, *(name for site in self.sites for name in site.nodes))

    @property
    def changing(self) -> tuple[NodePlan, ...]:
        return tuple(node for plan in self.plans if not plan.refusal for node in plan.of(Verdict.CHANGE))

    @property
    def replaced(self) -> dict[str, Any]:
        """Node -> what its change replaces, as JSON."""
        direct = {} if self.direct is None else replaced_by(self.direct)
        return direct | {name: state for site in self.sites for name, state in site.replaced.items()}

    def saved(self, opened: Session, choices: PlanOptions) -> SavedSitePlans:
        """These plans, as saved in a file."""
        direct = self.direct
        return SavedSitePlans(
            opened.fleet.name,
            None if direct is None else saved_plan(opened, direct, choices),
            {site.site.name: site.saved for site in self.sites if site.saved is not None},
            {site.site.name: Unplanned(site.nodes, str(site.error)) for site in self.sites if site.saved is None},
        )

    def close(self) -> None:
        for site in self.sites:
            site.close()


def sites_of(
    opened: Session, nodes: list[str] | None, limits: list[str] | None, *, direct: bool
) -> tuple[list[str], dict[str, tuple[str, ...]]]:
    """The names of the selected nodes: the operator's own, and those of sites with a worker."""
    selected = selected_nodes(opened.fleet, nodes, limits)
    if direct:
        return [node.name for node in selected], {}
    own, sites = by_site(opened.fleet, selected)
    return [node.name for node in own], sites


def prepare_everywhere(
    opened: Session,
    inventory: Path,
    own: list[str],
    sites: Mapping[str, Sequence[str]],
    choices: PlanOptions,
    *,
    reconnects: bool = False,
) -> WholePlan:
    """Plan the operator's own nodes here and the others at their sites. Raises InputError for a mesh at two sites."""
    _check_meshes(opened, sites)
    direct = prepare_plan(opened, own, choices, reconnects=reconnects) if own else None
    bundle_of = _bundles(opened, inventory, choices)
    options = [*_options(choices), *_reconnect_option(reconnects)]
    return WholePlan(direct, tuple(prepare_sites(opened.fleet, sites, opened.access, bundle_of, options)))


def prepare_saved(opened: Session, inventory: Path, saved: SavedSitePlans, file: str, *, reconnects: bool) -> WholePlan:
    """The parts of saved plans that still apply; the workers check those of their sites. Raises InputError."""
    check_placement(saved, opened.fleet, file)
    nodes = {name: tuple(plan.plan.nodes) for name, plan in saved.sites.items()}
    _check_meshes(opened, nodes)
    direct = prepare_agreed(opened, saved.direct, reconnects=reconnects) if saved.direct is not None else None
    bundle_of = _bundles(opened, inventory, PlanOptions(saved.with_firmware))
    agreed = {name: dump(plan) for name, plan in saved.sites.items()}
    options = _reconnect_option(reconnects)
    sites = prepare_sites(opened.fleet, nodes, opened.access, bundle_of, options, agreed) if nodes else []
    for name, missing in saved.unplanned.items():
        error = InputError(f"{file} has no plan of site {name}: {missing.error}", hint="make a new plan")
        sites.append(SitePlan(opened.fleet.sites[name], missing.nodes, "", error=error))
    return WholePlan(direct, tuple(sites))


def _bundles(opened: Session, inventory: Path, choices: PlanOptions) -> Callable[[str], SiteBundle]:
    """The bundle of a site by its name. For a rollback, it includes the earlier states of the site's own nodes."""
    renderer, nodes = opened.renderer, opened.fleet.nodes
    states = renderer.states if isinstance(renderer, EarlierStates) else {}

    def bundle_of(site: str) -> SiteBundle:
        return site_bundle(
            inventory,
            opened.fleet,
            site,
            renderer.secrets,
            opened.trust,
            os.environ,
            with_firmware=choices.with_firmware,
            earlier={name: state.to_json() for name, state in states.items() if nodes[name].site == site},
        )

    return bundle_of


def _check_meshes(opened: Session, sites: Mapping[str, Sequence[str]]) -> None:
    """A worker plans with the nodes of its site, so a mesh must not have others (MC132)."""
    fleet = opened.fleet
    for site in sites:
        for mesh in dict.fromkeys(mesh for name in sites[site] for mesh in fleet.nodes[name].meshes):
            elsewhere = [node.name for node in fleet.members(mesh) if node.site != site]
            if elsewhere:
                raise InputError(
                    f"mesh {mesh} has nodes at site {site} and elsewhere: {', '.join(elsewhere[:4])}",
                    hint="set the same `site` for all nodes of a mesh, or pass --direct",
                )


def _options(choices: PlanOptions) -> list[str]:
    """The options of `meshctl plan` at a site."""
    words = [] if choices.with_firmware else ["--no-firmware"]
    if choices.leave_behind:
        words += ["--leave-behind", ",".join(choices.leave_behind)]
    if choices.accept_cuts:
        words += ["--accept-cut", ",".join(choices.accept_cuts)]
    return [*words, "--together"] if choices.together else words


def _reconnect_option(reconnects: bool) -> list[str]:
    """The option of `meshctl plan` and `apply` at a site with which they reach nodes as `provision` does."""
    return ["--reconnect"] if reconnects else []


def show_everywhere(opened: Session, plan: WholePlan, *, brief: bool, raised: Plan | None = None) -> None:
    """Print the plans; without the refusal of `raised`, which is the command's error."""

    def show_one(made: Plan) -> None:
        show(replace(made, refusal="", refusal_hint="") if made is raised else made, opened.fleet, brief=brief)

    if plan.direct is not None:
        show_one(plan.direct.plan)
    for site in plan.sites:
        echo(f"site {site.site.name}:")
        if site.is_queued:
            echo("  offline: an order would wait for it; what still applies of its plan is found out there")
        if site.saved is not None:
            show_one(site.saved.plan)
        if site.error is not None:
            echo(f"  no plan: {site.error}")
            if site.error.hint:
                echo(f"  hint: {site.error.hint}")


def report_everywhere(
    opened: Session, plan: WholePlan, choices: PlanOptions, *, as_json: bool, brief: bool
) -> ExitCode:
    """Print the plans; with `as_json`, as `meshctl plan --out` saves them. FINDINGS as for `report_plan`, or if a site
    could not plan."""
    if as_json:
        echo_json(dump_site_plans(plan.saved(opened, choices)), nl=False)
    else:
        show_everywhere(opened, plan, brief=brief)
    if any(site.error is not None for site in plan.sites):
        return ExitCode.FINDINGS
    return max((plan_code(each) for each in plan.plans), default=ExitCode.OK)


def check_everywhere(opened: Session, plan: WholePlan, *, as_json: bool, brief: bool) -> ExitCode:
    """Print what differs, as `report_check` does without sites; a site that could not plan is among it."""
    verdicts = {node.node: (node.verdict, node.reason) for each in plan.plans for node in each.nodes.values()}
    for site in plan.sites:
        if site.saved is None:
            verdict = Verdict.AWAY if isinstance(site.error, Unreachable) else Verdict.REFUSED
            verdicts |= dict.fromkeys(site.nodes, (verdict, str(site.error)))
    if as_json:
        print_verdicts(opened.fleet.name, verdicts)
    else:
        show_everywhere(opened, plan, brief=brief)
    return check_code(verdicts)


def confirm_everywhere(opened: Session, plan: WholePlan, *, yes: bool) -> None:
    """Ask once for all. Raises PlanRefused if nothing can be done."""
    if plan.refusal is not None:
        raise PlanRefused(plan.refusal.refusal, hint=plan.refusal.refusal_hint)
    count = len(plan.changing)
    if count and not yes:
        there = sum(1 for site in plan.sites if site.saved is not None and not site.saved.plan.is_empty)
        confirm(f"Change {counted(count, 'node')}, at {counted(there, 'site')}?")


def execute_everywhere(opened: Session, plan: WholePlan, options: RunOptions) -> typer.Exit:
    """Execute all plans in one run; returns the exit to raise."""
    runs = {site.site.name: site.run for site in plan.sites if _is_to_start(site)}
    keys = {site.run: ReplyKey.new() for site in plan.sites if site.is_queued}
    orders = {
        site.run: signed_order(opened, site, options.command, options.rate_kb_s, keys.get(site.run))
        for site in plan.sites
        if _is_to_start(site)
    }
    stages = [] if plan.direct is None else [[stage.kind.value, *stage.nodes] for stage in plan.direct.plan.stages]
    undoes = {} if options.undoes is None else {"undoes": options.undoes}
    recorded = json.dumps({"choices": asdict(options.choices), "stages": stages, "sites": runs, **undoes})
    changing = [node.node for node in plan.changing]
    with journaled_run(
        opened, options.command, plan.names, changing=changing, plan=recorded, as_json=options.as_json
    ) as run:
        save_before(opened, run, plan.changing, plan.replaced)
        late = LateReplaced(opened, run.entry)
        late.expect(keys)
        _finish_others(opened, plan, run)
        site_runs = [
            SiteRun(
                site.site,
                site.run,
                site.nodes,
                parcel=orders[site.run],
                uplink=site.uplink,
                waits_until=expiry(opened, site) if site.is_queued else "",
            )
            for site in plan.sites
            if _is_to_start(site)
        ]
        execution = SiteExecution(opened.fleet, opened.access, run.entry, run.progress, opened.interrupt, late.keep)
        with ThreadPoolExecutor(1, "sites") as pool:
            at_sites = pool.submit(execution.execute, site_runs)
            if plan.direct is not None:
                run.outcomes.update(execute_direct(opened, run, plan.direct, rate=options.rate_kb_s))
            run.outcomes.update(at_sites.result())
    retry = retry_hint(options.command, options.undoes)
    return print_totals(opened, run, as_json=options.as_json, retry=retry)


def change_everywhere(
    opened: Session,
    inventory: Path,
    own: list[str],
    sites: Mapping[str, Sequence[str]],
    options: RunOptions,
    *,
    yes: bool,
    brief: bool,
    dry_run: bool,
    check: bool = False,
) -> typer.Exit:
    """Plan, show, ask and execute, where some nodes are provisioned by the workers of their sites."""
    reconnects = not check and not dry_run
    with closing(prepare_everywhere(opened, inventory, own, sites, options.choices, reconnects=reconnects)) as made:
        if check:
            return typer.Exit(check_everywhere(opened, made, as_json=options.as_json, brief=brief))
        if dry_run:
            return typer.Exit(report_everywhere(opened, made, options.choices, as_json=options.as_json, brief=brief))
        if not options.as_json:
            show_everywhere(opened, made, brief=brief, raised=made.refusal)
        confirm_everywhere(opened, made, yes=yes)
        return execute_everywhere(opened, made, options)


def _is_to_start(site: SitePlan) -> bool:
    return site.saved is not None and not site.saved.plan.refusal and not site.saved.plan.is_empty


def _finish_others(opened: Session, plan: WholePlan, run: JournaledRun) -> None:
    """The outcomes of nodes that no worker has to change: without a plan, refused, or as they should be."""
    for site in plan.sites:
        if _is_to_start(site):
            continue
        site.close()
        for name in site.nodes:
            outcome = _outcome_without_run(opened, site, name)
            run.outcomes[name] = outcome
            run.entry.finish_node(outcome)
            run.progress(Event(EventKind.FINISHED, name, time.time(), outcome.reason, outcome=outcome))


def _outcome_without_run(opened: Session, site: SitePlan, name: str) -> Outcome:
    if site.saved is None:
        error = site.error or MeshctlError("no plan")
        # errors of the uplink and of the worker name the site
        result = Result.UNREACHABLE if isinstance(error, Unreachable) else Result.REFUSED
        return Outcome(name, result, str(error), error.hint)
    plan = site.saved.plan
    if name not in plan.nodes:
        return Outcome(name, Result.REFUSED, f"site {site.site.name}: the worker did not plan it")
    if outcome := unchanged_outcome(opened.fleet, plan.nodes[name]):
        return outcome
    return Outcome(name, Result.REFUSED, plan.refusal, plan.refusal_hint)


def meet(opened: Session, record: RunRecord, *, as_json: bool) -> tuple[str, ...] | None:
    """Follow the sites' parts of an earlier run to their end, and complete its entry in the journal. Returns the nodes
    of the parts whose end is still not known; None if the run has no such parts."""
    recorded = json.loads(record.plan) if record.plan else {}
    started: Mapping[str, str] = recorded.get("sites", {})
    left = opened.journal.unfinished(record.id)
    runs = [
        SiteRun(opened.fleet.sites[site], run, nodes)
        for site, run in started.items()
        if site in opened.fleet.sites and (nodes := _nodes_at(opened, left, site))
    ]
    if not runs:
        return None
    entry = Run(opened.journal, record.id)
    names = [name for run in runs for name in run.nodes]
    if not as_json:
        echo(f"run {record.id}: asking {', '.join(run.site.name for run in runs)} how it ended")
    with progress_for(len(names), as_json=as_json) as progress, opened.interrupt.on_signals(progress.stopping):
        execution = SiteExecution(
            opened.fleet, opened.access, entry, progress, opened.interrupt, LateReplaced(opened, entry).keep
        )
        execution.execute(runs)
    entry.end(str(totals(opened.journal.outcomes(record.id))))
    if opened.interrupt.stopping:
        echo_error("interrupted before it was known")
        raise typer.Exit(ExitCode.INTERRUPTED)
    return tuple(name for run in runs if run.is_unknown for name in run.nodes)


def _nodes_at(opened: Session, names: Iterable[str], site: str) -> tuple[str, ...]:
    nodes = opened.fleet.nodes
    return tuple(name for name in names if name in nodes and nodes[name].site == site)
