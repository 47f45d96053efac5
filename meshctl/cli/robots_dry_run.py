"""`--dry-run` of the `meshctl robots` commands: what a command would change on each robot, without changing it.

`deploy_differences` compares the bundle with the robot; the others read the robot's facts (one round trip) and describe
what the command would stop, remove or lose. `print_differences` runs one of them on all robots and prints the result.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable

import typer

from meshctl.cli.context import exit_for
from meshctl.cli.output import echo_json, echo_lines
from meshctl.cli.robots_context import RobotsContext, RobotTask
from meshctl.errors import ExitCode
from meshctl.fleet import Outcome, Result
from meshctl.robots.bundle import BRIDGE_UNIT_NAME, HOSTS_UNIT_NAME, UNIT_NAME, UNIT_TITLES
from meshctl.robots.collector_release import COLLECTOR_UNIT_NAME
from meshctl.robots.deploy import plan_deploy
from meshctl.robots.expected_release import ExpectedRelease
from meshctl.robots.facts import RobotFacts, collect_facts
from meshctl.robots.host import Host
from meshctl.robots.status_table import difference
from meshctl.wording import counted


def print_differences(context: RobotsContext, work: RobotTask) -> dict[str, Outcome]:
    """Run `work`, whose outcomes have one difference per line of `reason`, and print them."""
    outcomes = context.run_on_each(work)
    if context.as_json:
        objects = {
            name: {"result": outcome.result.value, "differences": outcome.reason.splitlines()}
            for name, outcome in outcomes.items()
        }
        echo_json(json.dumps(objects, indent=1))
    else:
        for name, outcome in outcomes.items():
            for line in (outcome.reason or "no changes").splitlines():
                echo_lines(f"{name}: {line}")
    return outcomes


def exit_for_dry_run(context: RobotsContext, work: RobotTask) -> typer.Exit:
    """Print the differences; returns the exit to raise: FINDINGS if a robot would refuse."""
    outcomes = print_differences(context, work)
    if any(outcome.result is Result.REFUSED for outcome in outcomes.values()):
        return typer.Exit(ExitCode.FINDINGS)
    reached = [outcome for outcome in outcomes.values() if outcome.result is not Result.PENDING]
    return typer.Exit(exit_for(reached, context.opened.interrupt))


def deploy_differences(context: RobotsContext) -> RobotTask:
    """The changes that a deploy would make."""

    def work(host: Host, robot: str) -> Outcome:
        plan = plan_deploy(host, robot, context.options)
        if isinstance(plan, Outcome):
            return plan
        lines = difference(*plan)
        return Outcome(robot, Result.PENDING if lines else Result.UNCHANGED, "\n".join(lines))

    return work


def command_differences(command: str, *, purge: bool = False) -> RobotTask:
    """The changes that `restart`, `stop`, `rollback` or `uninstall` would make."""
    describe: Callable[[RobotFacts], tuple[str, ...]] = {
        "restart": lambda facts: _service_changes(facts, "restart"),
        "stop": lambda facts: _service_changes(facts, "stop"),
        "rollback": _rollback_changes,
        "uninstall": lambda facts: _removal_changes(facts, purge=purge),
    }[command]

    def work(host: Host, robot: str) -> Outcome:
        facts = collect_facts(host, robot, ExpectedRelease(), now_s=time.time())
        if not facts.release:
            hint = "run `meshctl robots deploy` first"
            return Outcome(robot, Result.REFUSED, "udp_mesh is not installed", hint=hint)
        lines = describe(facts)
        if not lines:
            return Outcome(robot, Result.REFUSED, "there is no previous release", hint="run `meshctl robots deploy`")
        return Outcome(robot, Result.PENDING, "\n".join(lines))

    return work


def _service_changes(facts: RobotFacts, verb: str) -> tuple[str, ...]:
    units = {
        UNIT_NAME: facts.service,
        BRIDGE_UNIT_NAME: facts.bridge,
        HOSTS_UNIT_NAME: facts.hosts,
        COLLECTOR_UNIT_NAME: facts.collector,
    }
    return (
        *(
            f"would {verb} {UNIT_TITLES[name]}, which is {unit.active or 'not installed'}"
            for name, unit in units.items()
            if unit is not None
        ),
        *_lost_messages(facts),
    )


def _lost_messages(facts: RobotFacts) -> tuple[str, ...]:
    queued = sum(queue.messages for queue in facts.queues)
    return (f"would lose {_messages(queued)} queued in memory",) if queued else ()


def _rollback_changes(facts: RobotFacts) -> tuple[str, ...]:
    """Empty if there is no previous release."""
    if not facts.previous:
        return ()
    return (f"would switch from release {facts.release} to {facts.previous}", *_lost_messages(facts))


def _removal_changes(facts: RobotFacts, *, purge: bool) -> tuple[str, ...]:
    stored = sum(peer.outbox_messages for peer in facts.peers)
    kept = "delete" if purge else "keep"
    return (
        f"would remove release {facts.release}" + (f" and {facts.previous}" if facts.previous else ""),
        *([f"would {kept} the stored messages, {_messages(stored)} for offline peers among them"] if stored else []),
        *(["would remove the system user and its state"] if purge else []),
        *_lost_messages(facts),
    )


def _messages(count: int) -> str:
    return counted(count, "message")
