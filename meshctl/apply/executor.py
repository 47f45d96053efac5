"""Execute a plan stage by stage; every node ends with one outcome, journaled at once.

`execute` runs the nodes of a stage in parallel (`_change_node`: firmware, or packages and then files) and a mesh change
as one. A failed canary, an exhausted failure budget or Ctrl-C prevents further starts; nodes in progress finish.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from meshctl.apply.commit_confirm import configure
from meshctl.apply.context import NodeContext, RunContext
from meshctl.apply.health_checks import expectation
from meshctl.apply.images import checked_image
from meshctl.apply.mesh_commit import commit_mesh
from meshctl.apply.packages import install
from meshctl.apply.prepare import Prepared
from meshctl.apply.stale_stations import unflushed_boot_s
from meshctl.apply.station_flush import UNFLUSHED, StationFlushes
from meshctl.apply.sysupgrade import flash
from meshctl.device.ssh import SshConnection
from meshctl.errors import NodeError
from meshctl.fleet import (
    Event,
    EventKind,
    FailureBudget,
    Observer,
    Outcome,
    Result,
    Tee,
    outcome_of_error,
    run,
)
from meshctl.fleet.journal import Journal, Run
from meshctl.model import Fleet, NodeState
from meshctl.nodes.connections import ConnectionPool
from meshctl.nodes.last_seen import query_neighbors
from meshctl.nodes.slots import MESH_SLOTS, nodes_in_work
from meshctl.plan import NodePlan, Plan, Stage, StageKind, Verdict


def execute(
    prepared: Prepared, run_context: RunContext, flushes: StationFlushes, unflushed: Mapping[str, float]
) -> dict[str, Outcome]:
    """Apply the plan. `unflushed` is the result of `unflushed_since`; the radios of these nodes are flushed as well.

    Raises InputError and InvalidInput, before any change, for an image that does not match the inventory.
    """
    plan, fleet = prepared.plan, run_context.fleet
    images = {
        node.hardware.name: checked_image(node.hardware)
        for node in (fleet.nodes[made.node] for made in plan.of(Verdict.CHANGE) if made.firmware is not None)
    }
    outcomes = {name: outcome for name, made in plan.nodes.items() if (outcome := unchanged_outcome(fleet, made))}
    for outcome in outcomes.values():
        _finish(run_context, outcome)
    contexts = _node_contexts(prepared, run_context)
    for name, since_s in unflushed.items():
        flushes.flush_later(_node_context(prepared, run_context, name), max(0.0, time.time() - since_s))
    budget = FailureBudget(fleet.apply.stop_after_failures)
    stopped = ""
    for stage in plan.stages:
        # an interrupted canary is not a failed one
        reason = "interrupted before it started" if run_context.interrupt.stopping else stopped
        if reason:
            ended = {name: Outcome(name, Result.PENDING, reason) for name in stage.nodes}
            for outcome in ended.values():
                _finish(run_context, outcome)
        else:
            ended = _run_stage(stage, contexts, plan, run_context, budget, images)
        outcomes.update(ended)
        if stage.kind is StageKind.CANARY and any(outcome.result.is_failure for outcome in ended.values()):
            stopped = f"stopped: the canary {stage.nodes[0]} failed"
        elif budget.is_exhausted:
            stopped = budget.reason
    outcomes.update(_with_last_seen(prepared, run_context, contexts, outcomes))
    outcomes.update(_with_unflushed_neighbors(flushes.retry_unanswered(run_context), run_context, outcomes))
    return {name: outcomes[name] for name in plan.nodes}


def assign_slots(prepared: Prepared, connections: ConnectionPool) -> None:
    """Nodes that were observed in a mesh share its channel; the entry nodes are reached by a cable."""
    for name, made in prepared.plan.nodes.items():
        is_behind_mesh = made.is_meshed and bool(prepared.plan.entries) and name not in prepared.plan.entries
        connections.slots.assign(name, made.meshes[0] if is_behind_mesh and made.meshes else "")


def unflushed_since(prepared: Prepared, journal: Journal) -> dict[str, float]:
    """Node -> since when (Unix time) its radios may have restarted without a station flush: the end of a change was not
    observed, or the node has booted since. Only nodes that answered."""
    observations = prepared.observed.observations
    missing = journal.unfinished_changes(prepared.plan.fleet)
    booted = {name: unflushed_boot_s(name, observations) for name in prepared.plan.nodes}
    since_s = {name: at_s for name, at_s in booted.items() if at_s is not None} | missing
    return {name: at_s for name, at_s in since_s.items() if name in prepared.plan.nodes and name in observations}


# batman-adv's loop avoidance (30 s), and a radio that comes up slowly
_RECONNECT_S = 90.0
# Results of a node that was in progress and is unreachable now.
_LOST = (Result.UNCERTAIN, Result.UNREACHABLE)


def _with_last_seen(
    prepared: Prepared, run_context: RunContext, contexts: Mapping[str, NodeContext], outcomes: Mapping[str, Outcome]
) -> dict[str, Outcome]:
    """The outcomes of nodes that did not come back, with their last known state and who still hears them."""
    missing = [name for name in contexts if outcomes[name].result in _LOST]
    if not missing or run_context.interrupt.leaving:
        return {}
    fleet = run_context.fleet
    known = run_context.journal.last_known(fleet.name)
    found = query_neighbors(
        run_context.connections, fleet, missing, prepared.observed, known, interrupt=run_context.interrupt
    )
    updated = {}
    for name, place in found.items():
        text = place.text(time.time())
        outcome = outcomes[name]
        updated[name] = replace(outcome, reason=f"{outcome.reason}; {text}", facts={**outcome.facts, **place.facts})
        run_context.journal_run.finish_node(updated[name])
        run_context.observer(Event(EventKind.NOTE, name, time.time(), text))
    return updated


def _with_unflushed_neighbors(
    unflushed: Mapping[str, Sequence[str]], run_context: RunContext, outcomes: Mapping[str, Outcome]
) -> dict[str, Outcome]:
    """The outcomes of nodes of which some neighbors may still hold a stale station entry, with these neighbors."""
    updated = {}
    for name, neighbors in unflushed.items():
        updated[name] = replace(outcomes[name], facts={**outcomes[name].facts, UNFLUSHED: " ".join(neighbors)})
        run_context.journal_run.finish_node(updated[name])
    return updated


def _finish(run_context: RunContext, outcome: Outcome) -> None:
    run_context.journal_run.finish_node(outcome)
    run_context.observer(Event(EventKind.FINISHED, outcome.node, time.time(), outcome.reason, outcome=outcome))


def unchanged_outcome(fleet: Fleet, plan: NodePlan) -> Outcome | None:
    """The outcome of a node that is not changed; None for one that is."""
    match plan.verdict:
        case Verdict.SAME:
            return Outcome(plan.node, Result.UNCHANGED)
        case Verdict.REFUSED:
            return Outcome(plan.node, Result.REFUSED, plan.reason, hint=plan.hint)
        case Verdict.AWAY:
            must_answer = fleet.nodes[plan.node].state is NodeState.DEPLOYED
            return Outcome(plan.node, Result.UNREACHABLE if must_answer else Result.PENDING, plan.reason)
        case Verdict.CHANGE:
            return None


def _node_contexts(prepared: Prepared, run_context: RunContext) -> dict[str, NodeContext]:
    changing = (name for name, plan in prepared.plan.nodes.items() if plan.verdict is Verdict.CHANGE)
    return {name: _node_context(prepared, run_context, name) for name in changing}


def _node_context(prepared: Prepared, run_context: RunContext, name: str) -> NodeContext:
    observation, desired = prepared.observed.observations[name], prepared.desired[name]
    node = run_context.fleet.nodes[name]
    expected = expectation(desired, observation, run_context.current_base_macs(node))
    return NodeContext(run_context, node, prepared.plan.nodes[name], desired, observation, expected)


def _run_stage(
    stage: Stage,
    contexts: Mapping[str, NodeContext],
    plan: Plan,
    run_context: RunContext,
    budget: FailureBudget,
    images: Mapping[str, Path],
) -> dict[str, Outcome]:
    observer = Tee((_journaling(run_context.journal_run), run_context.observer))
    if stage.kind.is_simultaneous:
        ended = _simultaneous_stage(stage, contexts, plan, run_context, observer)
        for outcome in ended.values():
            budget.count(outcome)
        return ended
    return run(
        stage.nodes,
        lambda name: _change_node(contexts[name], images),
        # the stage limits which nodes may be down together, the policy how many are worked on at once
        parallel=nodes_in_work(run_context.fleet.apply.parallel),
        budget=budget,
        interrupt=run_context.interrupt,
        observer=observer,
    )


def _journaling(journal_run: Run) -> Observer:
    def write(event: Event) -> None:
        if event.outcome is not None:
            journal_run.finish_node(event.outcome)

    return write


def _change_node(ctx: NodeContext, images: Mapping[str, Path]) -> Outcome:
    """Change firmware, or packages and then files. NodeError means that nothing was changed."""
    if ctx.plan.firmware is not None:
        return flash(ctx, _connection(ctx), images[ctx.node.hardware.name])
    outcome = Outcome(ctx.name, Result.DONE)
    if ctx.plan.packages is not None:
        outcome = install(ctx, _connection(ctx), ctx.plan.packages)
    if not ctx.plan.reloads or not outcome.result.is_good:
        return outcome
    try:
        return configure(ctx, _connection(ctx))
    except NodeError as error:
        if ctx.plan.packages is None:
            raise
        # its packages stay installed, so a resume only has to apply the files
        failed = outcome_of_error(ctx.name, error)
        return replace(
            failed, result=Result.FAILED, reason=f"its packages are installed, but its files are not applied: {error}"
        )


def _connection(ctx: NodeContext) -> SshConnection:
    """The pooled connection, or a new one to where the node is now: on the bench, if it was discovered there."""
    connections = ctx.run.connections
    return connections.acquire(ctx.name) or connections.open(
        ctx.node, endpoint=connections.bench_endpoints.get(ctx.name)
    )


def _simultaneous_stage(
    stage: Stage, contexts: Mapping[str, NodeContext], plan: Plan, run_context: RunContext, observer: Observer
) -> dict[str, Outcome]:
    """Install packages first, one node at a time; then change all nodes simultaneously."""
    began = time.monotonic()
    for name in stage.nodes:
        observer(Event(EventKind.STARTED, name, time.time()))
    failed = _packages_first(stage, contexts)
    if failed is not None:
        what = "the mesh change" if stage.kind is StageKind.SWITCH else "the simultaneous change"
        is_interrupted = failed.result is Result.PENDING
        why = "interrupted" if is_interrupted else f"packages could not be installed on {failed.node}"
        ended = {name: Outcome(name, Result.PENDING, f"{what} was canceled: {why}") for name in stage.nodes}
        ended[failed.node] = failed
    else:
        with_files = [name for name in stage.nodes if contexts[name].plan.reloads]
        ended = {name: Outcome(name, Result.DONE) for name in stage.nodes}
        if with_files:
            if any(step.remove for name in stage.nodes if (step := contexts[name].plan.packages) is not None):
                _connect_again(contexts[name] for name in with_files)
            ended |= commit_mesh(
                run_context,
                [contexts[name] for name in with_files],
                quorum=run_context.fleet.apply.quorum,
                parallel=min(nodes_in_work(run_context.fleet.apply.parallel), MESH_SLOTS[1]),
                entries=plan.entries,
                together=stage.kind is StageKind.TOGETHER,
            )
    took_s = round(time.monotonic() - began, 3)
    updated = {name: replace(outcome, duration_s=took_s) for name, outcome in ended.items()}
    for outcome in updated.values():
        observer(Event(EventKind.FINISHED, outcome.node, time.time(), outcome.reason, outcome=outcome))
    return updated


def _connect_again(contexts: Iterable[NodeContext]) -> None:
    """Another supplicant restarts the radios, the entry's last: connections through it are cut, and batman-adv's loop
    avoidance may hold new ones for 30 s. Who does not answer in time is found by `commit_mesh`."""
    until = time.monotonic() + _RECONNECT_S
    for ctx in contexts:
        connections = ctx.run.connections
        connections.drop(ctx.name)
        while not ctx.run.interrupt.stopping:
            try:
                connections.release(ctx.name, _connection(ctx))
                break
            except NodeError:
                if time.monotonic() >= until:
                    break
                ctx.run.interrupt.wait(1.0)


def _packages_first(stage: Stage, contexts: Mapping[str, NodeContext]) -> Outcome | None:
    """The outcome of the first node whose packages were not installed: the change is canceled on all, so the others
    keep their packages, too."""
    for name in stage.nodes:
        step = contexts[name].plan.packages
        if step is None:
            continue
        if contexts[name].run.interrupt.stopping:
            return Outcome(name, Result.PENDING, "interrupted before its packages were installed")
        try:
            outcome = install(contexts[name], _connection(contexts[name]), step)
        except NodeError as error:
            outcome = outcome_of_error(name, error)
        if not outcome.result.is_good:
            return outcome
    return None
