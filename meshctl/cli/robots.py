"""`meshctl robots`: deploy, inspect and remove udp_mesh on the robots' computers.

Each command gets a `RobotsContext` (robots_context.py), works on all selected robots in parallel, and reports one
outcome per robot. Topics and keys, which also change the inventory, are in robots_topics.py.
"""

from __future__ import annotations

import json
import time
from typing import Annotated

import typer

from meshctl.cli.context import DryRun, exit_for, line_width
from meshctl.cli.key_pinning import pin_host_key
from meshctl.cli.output import echo, echo_json, echo_lines
from meshctl.cli.robots_context import SERVICE_TIMEOUT_S, RobotsContext, finish, run_command, with_robots_context
from meshctl.cli.robots_dry_run import (
    command_differences,
    deploy_differences,
    exit_for_dry_run,
    print_differences,
)
from meshctl.cli.robots_topics import rotate_key_command, topic_app
from meshctl.errors import ExitCode, NodeError
from meshctl.fleet import Outcome, Result
from meshctl.robots.expected_release import expected_release
from meshctl.robots.facts import RobotFacts, collect_facts, facts_object
from meshctl.robots.host import Host
from meshctl.robots.status_table import table

app = typer.Typer(help="Deploy and manage udp_mesh on robots.", no_args_is_help=True)
app.add_typer(topic_app, name="topic")
app.command("rotate-key")(rotate_key_command)


@app.command("deploy")
@with_robots_context("robots", "limit", "inventory", "wheels", "wait_s", "ask_sudo", "as_json", "key")
def deploy_command(context: RobotsContext, dry_run: DryRun = False) -> None:
    """Install or upgrade udp_mesh with the inventory's configuration; an unhealthy release is rolled back.

    Example: meshctl robots deploy 'husky*' --wheels wheels/
    """
    context = context.with_fleet(context.fleet)
    if dry_run:
        raise exit_for_dry_run(context, deploy_differences(context))
    raise finish(context, run_command(context, "deploy"))


@app.command("diff")
@with_robots_context("robots", "limit", "inventory", "wheels", "ask_sudo", "as_json", "key", changes_nothing=True)
def diff_command(context: RobotsContext) -> None:
    """Show what a deploy would change on each robot, including changes by hand. Exit with 1 if there are any.

    Example: meshctl robots diff
    """
    context = context.with_fleet(context.fleet)
    outcomes = print_differences(context, deploy_differences(context))
    if any(outcome.result in (Result.PENDING, Result.REFUSED) for outcome in outcomes.values()):
        raise typer.Exit(ExitCode.FINDINGS)
    raise typer.Exit(exit_for(outcomes.values(), context.opened.interrupt))


@app.command("status")
@with_robots_context("robots", "limit", "inventory", "ask_sudo", "as_json", "key", changes_nothing=True)
def status_command(context: RobotsContext) -> None:
    """Show each daemon: service state, uptime, peers and queues. Exit with 0 only if all are healthy.

    Example: meshctl robots status
    """
    found: dict[str, RobotFacts] = {}
    expected = {name: expected_release(context.fleet, name, context.options.secrets) for name in context.robots}

    def work(host: Host, robot: str) -> Outcome:
        others = context.fleet.robots[robot].other_addresses
        found[robot] = collect_facts(host, robot, expected[robot], now_s=time.time(), others=others)
        return Outcome(robot, Result.DONE if found[robot].is_healthy else Result.FAILED)

    outcomes = context.run_on_each(work)
    rows = [found.get(name, RobotFacts(name, error=outcome.reason)) for name, outcome in outcomes.items()]
    if context.as_json:
        echo_json(json.dumps([facts_object(row) for row in rows], indent=2))
    else:
        echo(table(rows, line_width()))
    raise typer.Exit(exit_for(outcomes.values(), context.opened.interrupt))


@app.command("restart")
@with_robots_context("robots", "limit", "inventory", "ask_sudo", "as_json", "key")
def restart_command(context: RobotsContext, dry_run: DryRun = False) -> None:
    """Restart the daemons and bridges. Messages queued in memory are lost; those on disk are kept.

    Example: meshctl robots restart husky1
    """
    if dry_run:
        raise exit_for_dry_run(context, command_differences("restart"))
    raise finish(context, run_command(context, "restart"))


@app.command("stop")
@with_robots_context("robots", "limit", "inventory", "ask_sudo", "as_json", "key")
def stop_command(context: RobotsContext, dry_run: DryRun = False) -> None:
    """Stop the daemons and bridges until the next deploy, restart or boot.

    Example: meshctl robots stop husky1
    """
    if dry_run:
        raise exit_for_dry_run(context, command_differences("stop"))
    raise finish(context, run_command(context, "stop"))


@app.command("logs")
@with_robots_context("robots", "limit", "inventory", "ask_sudo", "key", changes_nothing=True)
def logs_command(
    context: RobotsContext,
    lines: Annotated[int, typer.Option("--lines", "-n", min=1, help="Number of lines per robot.")] = 50,
    since: Annotated[
        str, typer.Option("--since", metavar="TIME", help="Only lines since this time: '10 min ago', 'today'.")
    ] = "",
) -> None:
    """Print the logs of the daemons and bridges.

    Example: meshctl robots logs husky1 -n 100
    """

    def work(host: Host, robot: str) -> Outcome:
        text = host.run("logs", str(lines), since, timeout_s=SERVICE_TIMEOUT_S)
        return Outcome(robot, Result.DONE, facts={"log": text})

    outcomes = context.run_on_each(work)
    for name, outcome in outcomes.items():
        for line in outcome.facts.get("log", "").splitlines():
            echo(f"{name}: {line}")
        if not outcome.result.is_good:
            echo_lines(str(outcome), err=True)
    raise typer.Exit(exit_for(outcomes.values(), context.opened.interrupt))


@app.command("rollback")
@with_robots_context("robots", "limit", "inventory", "wait_s", "ask_sudo", "as_json", "key")
def rollback_command(context: RobotsContext, dry_run: DryRun = False) -> None:
    """Roll back to the previous release, with its configuration and keys.

    Example: meshctl robots rollback husky1
    """
    if dry_run:
        raise exit_for_dry_run(context, command_differences("rollback"))
    raise finish(context, run_command(context, "rollback"))


@app.command("uninstall")
@with_robots_context("named", "limit", "inventory", "ask_sudo", "as_json", "key")
def uninstall_command(
    context: RobotsContext,
    purge: Annotated[bool, typer.Option("--purge", help="Also remove stored messages and the system user.")] = False,
    dry_run: DryRun = False,
) -> None:
    """Remove udp_mesh from robots. Messages on disk are kept for the next install unless --purge is given.

    Example: meshctl robots uninstall husky1
    """
    if dry_run:
        raise exit_for_dry_run(context, command_differences("uninstall", purge=purge))
    raise finish(context, run_command(context, "uninstall", purge=purge))


@app.command("trust")
@with_robots_context("robots", "limit", "inventory", "key")
def trust_command(
    context: RobotsContext,
    change: Annotated[bool, typer.Option("--replace", "--replace-key", help="Also accept changed keys.")] = False,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Pin without confirmation.")] = False,
    dry_run: DryRun = False,
) -> None:
    """Show the robots' host key fingerprints and pin them in the fleet's known_hosts after confirmation.

    Example: meshctl robots trust husky1
    """
    trusted = {robot: _pin_key(context, robot, change=change, yes=yes, dry_run=dry_run) for robot in context.robots}
    if not all(trusted.values()):
        raise typer.Exit(ExitCode.FINDINGS)


def _pin_key(context: RobotsContext, robot: str, *, change: bool, yes: bool, dry_run: bool) -> bool:
    try:
        shown = context.connector.presented_key(robot)
    except NodeError as error:
        echo_lines(f"{robot}: {error}" + (f"\n  hint: {error.hint}" if error.hint else ""))
        return False
    assert shown is not None, "a completed handshake presents a key"
    name = context.connector.endpoint(robot).identity
    trust = context.opened.trust
    return pin_host_key(
        trust, name, shown, label=robot, device="computer", may_replace=change, yes=yes, dry_run=dry_run
    )
