"""`meshctl robots`: udp_mesh on the robots' computers, deployed, watched and taken away.

Each command gets a `RobotsContext` (robots_context.py), works on all chosen robots at once, and tells one
outcome for each. Topics and keys, which change the inventory too, are in robots_topics.py.
"""

from __future__ import annotations

import json
import sys
import time
from typing import Annotated

import typer

from meshctl.cli.context import exit_for, line_width
from meshctl.cli.output import echo, echo_json
from meshctl.cli.robots_context import SERVICE_TIMEOUT_S, RobotsContext, print_totals, run_command, with_robots_context
from meshctl.cli.robots_topics import rotate_key_command, topic_app
from meshctl.errors import ExitCode, NodeError
from meshctl.fleet import Outcome, Result
from meshctl.robots.deploy import plan_deploy
from meshctl.robots.facts import RobotFacts, collect_facts, expected_release, facts_object
from meshctl.robots.host import Host
from meshctl.robots.status_table import difference, table

app = typer.Typer(help="udp_mesh on the robots' computers: deploy, watch, change.", no_args_is_help=True)
app.add_typer(topic_app, name="topic")
app.command("rotate-key")(rotate_key_command)


@app.command("deploy")
@with_robots_context("robots", "inventory", "wheels", "wait_s", "ask_sudo", "as_json", "key")
def deploy_command(context: RobotsContext) -> None:
    """Install or upgrade udp_mesh with the inventory's configuration; a release that is not healthy goes back.

    Example: meshctl robots deploy 'husky*' --wheels wheels/
    """
    context = context.with_fleet(context.fleet)
    raise print_totals(context, run_command(context, "deploy"))


@app.command("diff")
@with_robots_context("robots", "inventory", "wheels", "ask_sudo", "as_json", "key")
def diff_command(context: RobotsContext) -> None:
    """Show what a deploy would change on each robot, and what was changed there by hand. Exit code 1 for a difference.

    Example: meshctl robots diff
    """
    context = context.with_fleet(context.fleet)

    def work(host: Host, robot: str) -> Outcome:
        plan = plan_deploy(host, robot, context.options)
        if isinstance(plan, Outcome):
            return plan
        lines = difference(*plan)
        return Outcome(robot, Result.PENDING if lines else Result.UNCHANGED, "\n".join(lines))

    outcomes = context.run_on_each(work)
    if context.as_json:
        told = {
            name: {"result": one.result.value, "differences": one.reason.splitlines()} for name, one in outcomes.items()
        }
        echo_json(json.dumps(told, indent=1))
    else:
        for name, one in outcomes.items():
            for line in (one.reason or "as the inventory says").splitlines():
                echo(f"{name}: {line}")
    if any(one.result in (Result.PENDING, Result.REFUSED) for one in outcomes.values()):
        raise typer.Exit(ExitCode.FINDINGS)
    raise typer.Exit(exit_for(outcomes.values(), context.opened.interrupt))


@app.command("status")
@with_robots_context("robots", "inventory", "ask_sudo", "as_json", "key")
def status_command(context: RobotsContext) -> None:
    """Show every daemon: does it run, since when, whom does it see, what waits. Exit code 0 only when all are well.

    Example: meshctl robots status
    """
    found: dict[str, RobotFacts] = {}
    wanted = {name: expected_release(context.fleet, name, context.options.secrets) for name in context.robots}

    def work(host: Host, robot: str) -> Outcome:
        found[robot] = collect_facts(host, robot, wanted[robot], now_s=time.time())
        return Outcome(robot, Result.DONE if found[robot].is_healthy else Result.FAILED)

    outcomes = context.run_on_each(work)
    rows = [found.get(name, RobotFacts(name, trouble=one.reason)) for name, one in outcomes.items()]
    if context.as_json:
        echo_json(json.dumps([facts_object(one) for one in rows], indent=2))
    else:
        echo(table(rows, line_width()))
    raise typer.Exit(exit_for(outcomes.values(), context.opened.interrupt))


@app.command("restart")
@with_robots_context("robots", "inventory", "ask_sudo", "as_json", "key")
def restart_command(context: RobotsContext) -> None:
    """Restart the daemons and bridges. What they hold in memory for others is lost; what is on disk stays.

    Example: meshctl robots restart husky1
    """
    raise print_totals(context, run_command(context, "restart"))


@app.command("stop")
@with_robots_context("robots", "inventory", "ask_sudo", "as_json", "key")
def stop_command(context: RobotsContext) -> None:
    """Stop the daemons and bridges until the next deploy, restart or boot.

    Example: meshctl robots stop husky1
    """
    raise print_totals(context, run_command(context, "stop"))


@app.command("logs")
@with_robots_context("robots", "inventory", "ask_sudo", "key")
def logs_command(
    context: RobotsContext,
    lines: Annotated[int, typer.Option("--lines", "-n", min=1, help="The last so many lines of each.")] = 50,
    since: Annotated[str, typer.Option("--since", help="Only from then on: '10 min ago', 'today'.")] = "",
) -> None:
    """Print the logs of the daemons and bridges.

    Example: meshctl robots logs husky1 -n 100
    """

    def work(host: Host, robot: str) -> Outcome:
        text = host.run("logs", str(lines), since, timeout_s=SERVICE_TIMEOUT_S)
        return Outcome(robot, Result.DONE, facts={"log": text})

    outcomes = context.run_on_each(work)
    for name, one in outcomes.items():
        for line in one.facts.get("log", "").splitlines():
            echo(f"{name}: {line}")
        if not one.result.is_good:
            echo(str(one), err=True)
    raise typer.Exit(exit_for(outcomes.values(), context.opened.interrupt))


@app.command("rollback")
@with_robots_context("robots", "inventory", "wait_s", "ask_sudo", "as_json", "key")
def rollback_command(context: RobotsContext) -> None:
    """Go back to the release before, with its configuration and keys.

    Example: meshctl robots rollback husky1
    """
    raise print_totals(context, run_command(context, "rollback"))


@app.command("uninstall")
@with_robots_context("named", "inventory", "ask_sudo", "as_json", "key")
def uninstall_command(
    context: RobotsContext,
    purge: Annotated[bool, typer.Option("--purge", help="Also messages kept for absent robots, and the user.")] = False,
) -> None:
    """Take udp_mesh off robots. Messages kept on disk wait for the next install unless --purge.

    Example: meshctl robots uninstall husky1
    """
    raise print_totals(context, run_command(context, "uninstall", purge=purge))


@app.command("trust")
@with_robots_context("robots", "inventory", "key")
def trust_command(
    context: RobotsContext,
    change: Annotated[bool, typer.Option("--replace", help="Also take keys that differ from the pinned ones.")] = False,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Pin without asking; compare fingerprints first.")] = False,
) -> None:
    """Show the computers' host key fingerprints, ask, and pin them in the fleet's known_hosts.

    Example: meshctl robots trust husky1
    """
    trusted = {robot: _pin_key(context, robot, change=change, yes=yes) for robot in context.robots}
    if not all(trusted.values()):
        raise typer.Exit(ExitCode.FINDINGS)


def _pin_key(context: RobotsContext, robot: str, *, change: bool, yes: bool) -> bool:
    """Tell, ask, pin; whether the computer's key is pinned in the end."""
    name = context.connector.endpoint(robot).identity
    try:
        shown = context.connector.presented_key(robot)
    except NodeError as error:
        echo(f"{robot}: {error}" + (f"\n  hint: {error.hint}" if error.hint else ""))
        return False
    assert shown is not None, "a completed handshake has shown a key"
    pinned = context.opened.trust.pinned(name)
    line = f"{robot}: {shown.fingerprint} ({shown.key_type})"
    if shown in pinned:
        echo(f"{line}: pinned")
        return True
    if pinned and not change:
        echo(f"{line}: DIFFERS from the pinned {', '.join(one.fingerprint for one in pinned)}")
        echo("  hint: another computer, a new installation, or an attack; --replace once you know which")
        return False
    if yes or (sys.stdin.isatty() and typer.confirm(f"{line}\n  Is this what the computer itself shows?")):
        context.opened.trust.replace(name, shown)
        echo(f"{line}: pinned now")
        return True
    echo(f"{line}: not pinned")
    return False
