"""`meshctl robots`: udp_mesh on the robots' computers, deployed, watched and taken away.

Each command opens a `Crew` (robots_crew.py), works on all chosen robots at once, and tells one outcome for each.
Topics and keys, which change the inventory too, are in robots_change.py.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Annotated

import typer

from meshctl.cli.options import AsJson, InventoryPath
from meshctl.cli.robots_change import rotate_key_command, topic_app
from meshctl.cli.robots_crew import AskSudo, Robots, Wait, Wheels, crew_of, end
from meshctl.cli.session import KeyFiles, exit_for, progress_for
from meshctl.errors import ExitCode, InputError, NodeError
from meshctl.fleet import Outcome, Result
from meshctl.robots.deploy import probe, refusal, roll_back, wanted
from meshctl.robots.facts import RobotFacts, expectation, facts_object, gather
from meshctl.robots.host import Host
from meshctl.robots.watch import difference, table

app = typer.Typer(help="udp_mesh on the robots' computers: deploy, watch, change.", no_args_is_help=True)
app.add_typer(topic_app, name="topic")
app.command("rotate-key")(rotate_key_command)

_SERVICE_TIMEOUT_S = 180.0


@app.command("deploy")
def deploy_command(
    robots: Robots = None,
    inventory: InventoryPath = Path(),
    wheels: Wheels = None,
    wait: Wait = 30,
    ask_sudo: AskSudo = False,
    as_json: AsJson = False,
    key: KeyFiles = None,
) -> None:
    """Install or upgrade udp_mesh with the inventory's configuration; a release that is not healthy goes back.

    Example: meshctl robots deploy 'husky*' --wheels wheels/
    """
    with crew_of(inventory, robots, key=key, ask_sudo=ask_sudo, wheels=wheels, wait_s=wait, as_json=as_json) as opened:
        crew = opened.at(opened.fleet)
        raise end(crew, crew.deploy())


@app.command("diff")
def diff_command(
    robots: Robots = None,
    inventory: InventoryPath = Path(),
    wheels: Wheels = None,
    ask_sudo: AskSudo = False,
    as_json: AsJson = False,
    key: KeyFiles = None,
) -> None:
    """Show what a deploy would change on each robot, and what was changed there by hand. Exit code 1 for a difference.

    Example: meshctl robots diff
    """
    with crew_of(inventory, robots, key=key, ask_sudo=ask_sudo, wheels=wheels, as_json=as_json) as opened:
        crew = opened.at(opened.fleet)
        order = crew.order

        def work(host: Host, robot: str) -> Outcome:
            computer = crew.reach.computer(robot)
            facts = probe(host, computer.python)
            refused = refusal(order, robot, computer, facts)
            if refused is not None:
                return refused
            try:
                lines = difference(facts, wanted(order, robot, facts))
            except InputError as error:
                return Outcome(robot, Result.REFUSED, str(error), error.hint)
            return Outcome(robot, Result.PENDING if lines else Result.UNCHANGED, "\n".join(lines))

        outcomes = crew.on_each(work)
        if as_json:
            told = {name: {"result": one.result.value, "differences": one.reason.splitlines()}
                    for name, one in outcomes.items()}  # fmt: skip
            typer.echo(json.dumps(told, indent=1))
        for name, one in outcomes.items():
            if not as_json:
                for line in (one.reason or "as the inventory says").splitlines():
                    typer.echo(f"{name}: {line}")
        if any(one.result in (Result.PENDING, Result.REFUSED) for one in outcomes.values()):
            raise typer.Exit(ExitCode.FINDINGS)
        raise typer.Exit(exit_for(outcomes.values(), crew.opened.interrupt))


@app.command("status")
def status_command(
    robots: Robots = None,
    inventory: InventoryPath = Path(),
    ask_sudo: AskSudo = False,
    as_json: AsJson = False,
    key: KeyFiles = None,
) -> None:
    """Show every daemon: does it run, since when, whom does it see, what waits. Exit code 0 only when all are well.

    Example: meshctl robots status
    """
    with crew_of(inventory, robots, key=key, ask_sudo=ask_sudo, as_json=as_json) as crew:
        found: dict[str, RobotFacts] = {}
        wanted = {name: expectation(crew.fleet, name, crew.order.secrets) for name in crew.robots}

        def work(host: Host, robot: str) -> Outcome:
            found[robot] = gather(host, robot, wanted[robot], now_s=time.time())
            return Outcome(robot, Result.DONE if found[robot].is_well else Result.FAILED)

        outcomes = crew.on_each(work)
        rows = [found.get(name, RobotFacts(name, trouble=one.reason)) for name, one in outcomes.items()]
        typer.echo(json.dumps([facts_object(one) for one in rows], indent=2) if as_json else table(rows))
        raise typer.Exit(exit_for(outcomes.values(), crew.opened.interrupt))


def _service(verb: str, inventory: Path, robots: list[str] | None, key: list[Path] | None, ask: bool, js: bool) -> None:
    with crew_of(inventory, robots, key=key, ask_sudo=ask, as_json=js) as crew:

        def work(host: Host, robot: str) -> Outcome:
            state = host.run("service", verb, timeout_s=_SERVICE_TIMEOUT_S).strip()
            return Outcome(robot, Result.DONE, f"the service is {state}")

        with progress_for(len(crew.robots), as_json=js) as progress:
            outcomes = crew.on_each(work, observer=progress)
        raise end(crew, outcomes)


@app.command("restart")
def restart_command(
    robots: Robots = None,
    inventory: InventoryPath = Path(),
    ask_sudo: AskSudo = False,
    as_json: AsJson = False,
    key: KeyFiles = None,
) -> None:
    """Restart the daemons. What they hold in memory for others is lost; what is on disk stays.

    Example: meshctl robots restart husky1
    """
    _service("restart", inventory, robots, key, ask_sudo, as_json)


@app.command("stop")
def stop_command(
    robots: Robots = None,
    inventory: InventoryPath = Path(),
    ask_sudo: AskSudo = False,
    as_json: AsJson = False,
    key: KeyFiles = None,
) -> None:
    """Stop the daemons until the next deploy, restart or boot.

    Example: meshctl robots stop husky1
    """
    _service("stop", inventory, robots, key, ask_sudo, as_json)


@app.command("logs")
def logs_command(
    robots: Robots = None,
    inventory: InventoryPath = Path(),
    lines: Annotated[int, typer.Option("--lines", "-n", min=1, help="The last so many lines of each.")] = 50,
    since: Annotated[str, typer.Option("--since", help="Only from then on: '10 min ago', 'today'.")] = "",
    ask_sudo: AskSudo = False,
    key: KeyFiles = None,
) -> None:
    """Print the daemons' logs.

    Example: meshctl robots logs husky1 -n 100
    """
    with crew_of(inventory, robots, key=key, ask_sudo=ask_sudo) as crew:

        def work(host: Host, robot: str) -> Outcome:
            text = host.run("logs", str(lines), since, timeout_s=_SERVICE_TIMEOUT_S)
            return Outcome(robot, Result.DONE, facts={"log": text})

        outcomes = crew.on_each(work)
        for name, one in outcomes.items():
            for line in one.facts.get("log", "").splitlines():
                typer.echo(f"{name}: {line}")
            if not one.result.is_good:
                typer.echo(str(one), err=True)
        raise typer.Exit(exit_for(outcomes.values(), crew.opened.interrupt))


@app.command("rollback")
def rollback_command(
    robots: Robots = None,
    inventory: InventoryPath = Path(),
    wait: Wait = 30,
    ask_sudo: AskSudo = False,
    as_json: AsJson = False,
    key: KeyFiles = None,
) -> None:
    """Go back to the release before, with its configuration and keys.

    Example: meshctl robots rollback husky1
    """
    with crew_of(inventory, robots, key=key, ask_sudo=ask_sudo, as_json=as_json) as crew:
        with progress_for(len(crew.robots), as_json=as_json) as progress:
            outcomes = crew.on_each(
                lambda host, robot: roll_back(host, robot, crew.reach.computer(robot), wait), observer=progress
            )
        raise end(crew, outcomes)


@app.command("uninstall")
def uninstall_command(
    robots: Annotated[list[str], typer.Argument(help="Robots, or patterns such as 'husky*'.")],
    inventory: InventoryPath = Path(),
    purge: Annotated[bool, typer.Option("--purge", help="Also messages kept for absent robots, and the user.")] = False,
    ask_sudo: AskSudo = False,
    as_json: AsJson = False,
    key: KeyFiles = None,
) -> None:
    """Take udp_mesh off robots. Messages kept on disk wait for the next install unless --purge.

    Example: meshctl robots uninstall husky1
    """
    with crew_of(inventory, robots, key=key, ask_sudo=ask_sudo, as_json=as_json) as crew:

        def work(host: Host, robot: str) -> Outcome:
            host.run("remove", "purge" if purge else "keep", timeout_s=_SERVICE_TIMEOUT_S)
            return Outcome(robot, Result.DONE, "removed")

        with progress_for(len(crew.robots), as_json=as_json) as progress:
            outcomes = crew.on_each(work, observer=progress)
        raise end(crew, outcomes)


@app.command("trust")
def trust_command(
    robots: Robots = None,
    inventory: InventoryPath = Path(),
    change: Annotated[bool, typer.Option("--replace", help="Also take keys that differ from the pinned ones.")] = False,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Pin without asking; compare fingerprints first.")] = False,
) -> None:
    """Show the computers' host key fingerprints, ask, and pin them in the fleet's known_hosts.

    Example: meshctl robots trust husky1
    """
    with crew_of(inventory, robots, key=None) as crew:
        left = 0
        for robot in crew.robots:
            name = crew.reach.endpoint(robot).identity
            try:
                shown = crew.reach.shown_key(robot)
            except NodeError as error:
                typer.echo(f"{robot}: {error}")
                left += 1
                continue
            assert shown is not None, "a completed handshake has shown a key"
            pinned = crew.opened.trust.pinned(name)
            line = f"{robot}: {shown.fingerprint} ({shown.key_type})"
            if shown in pinned:
                typer.echo(f"{line}: pinned")
            elif pinned and not change:
                typer.echo(f"{line}: DIFFERS from the pinned {', '.join(one.fingerprint for one in pinned)}")
                typer.echo("  hint: another computer, a new installation, or an attack; --replace once you know which")
                left += 1
            elif yes or (sys.stdin.isatty() and typer.confirm(f"{line}\n  Is this what the computer itself shows?")):
                crew.opened.trust.replace(name, shown)
                typer.echo(f"{line}: pinned now")
            else:
                typer.echo(f"{line}: not pinned")
                left += 1
        if left:
            raise typer.Exit(ExitCode.FINDINGS)
