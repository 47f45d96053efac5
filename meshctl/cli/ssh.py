"""`meshctl trust`, `run`, `ssh`: connect to nodes with the fleet's keys and pinned host keys."""

from __future__ import annotations

import json
import os
import shlex
import shutil
import sys
import threading
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from meshctl.cli.context import (
    AsJson,
    DryRun,
    InventoryPath,
    KeyFiles,
    Lab,
    Limit,
    Nodes,
    OneNode,
    Session,
    exit_for,
    selected_node,
    selected_nodes,
    session,
)
from meshctl.cli.key_pinning import pin_host_key
from meshctl.cli.output import echo, echo_bytes, echo_error, echo_json, echo_lines
from meshctl.device.framing import command_line
from meshctl.errors import ExitCode, InputError
from meshctl.fleet import Outcome, Result
from meshctl.fleet import run as run_on_all
from meshctl.model import Node, Site
from meshctl.nodes.host_keys import HostKeyState, fetch_host_keys
from meshctl.nodes.site_gateways import gateway_credentials, gateway_endpoint
from meshctl.nodes.slots import transfers_at_once


def trust(
    nodes: Nodes = None,
    limit: Limit = None,
    inventory: InventoryPath = Path(),
    change: Annotated[bool, typer.Option("--replace", "--replace-key", help="Also accept changed keys.")] = False,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Pin without confirmation.")] = False,
    dry_run: DryRun = False,
    as_json: AsJson = False,
    key: KeyFiles = None,
    lab: Lab = None,
) -> None:
    """Show the nodes' host key fingerprints and pin them in the fleet's known_hosts after confirmation.

    Exit code: 0 if all keys are pinned (with --dry-run: would be), 1 if not, 3 if no node answers.

    Example: meshctl trust b03
    """
    with session(inventory, key_files=key or (), lab=lab, changes_nothing=True) as opened:
        shown = fetch_host_keys(
            opened.access,
            opened.trust,
            selected_nodes(opened.fleet, nodes, limit),
            parallel=transfers_at_once(opened.fleet.apply.parallel),
        )
        if as_json:
            echo_json(json.dumps([_key_object(item) for item in shown], indent=1))
        left = 0
        for item in shown:
            left += not _pin_key(opened, item, may_replace=change, yes=yes, dry_run=dry_run, quiet=as_json)
        if left:
            none_answered = all(item.key is None for item in shown)
            raise typer.Exit(ExitCode.UNREACHABLE if none_answered else ExitCode.FINDINGS)


def _key_object(item: HostKeyState) -> dict[str, str]:
    return {
        "node": item.node.name,
        "state": item.state,
        "key_type": item.key.key_type if item.key else "",
        "fingerprint": item.key.fingerprint if item.key else "",
    }


def _pin_key(opened: Session, item: HostKeyState, *, may_replace: bool, yes: bool, dry_run: bool, quiet: bool) -> bool:
    name = item.node.name
    if item.key is None:
        if not quiet:
            echo_lines(f"{name}: {item.error}")
        return False
    return pin_host_key(
        opened.trust,
        name,
        item.key,
        label=name,
        device="node",
        may_replace=may_replace,
        yes=yes,
        dry_run=dry_run,
        quiet=quiet,
    )


def run(
    words: Annotated[
        list[str],
        typer.Argument(
            metavar="NODES -- COMMAND",
            help="Nodes or patterns (default: all), then -- and the command.",
        ),
    ],
    limit: Limit = None,
    inventory: InventoryPath = Path(),
    timeout: Annotated[float, typer.Option("--timeout", metavar="S", help="Timeout per node in seconds.")] = 60.0,
    raw: Annotated[
        bool, typer.Option("--raw", help="Print output unchanged: without node names, with control characters.")
    ] = False,
    as_json: AsJson = False,
    key: KeyFiles = None,
    lab: Lab = None,
) -> None:
    """Run a shell command on nodes, in parallel.

    A single word after -- is passed to the node's shell as is: pipes and variables are evaluated on the node. Several
    words are passed as literal arguments.

    Exit code: 0 if the command succeeds on every node, 1 if not, 3 if no node answers.

    Example: meshctl run 'husky*' -- uptime

    Example: meshctl run b01 b02 -- 'logread | grep -c batman'
    """
    if raw and as_json:
        raise InputError("expected --raw or --json, found both")
    patterns, command = _split(words)
    with session(inventory, key_files=key or (), lab=lab, changes_nothing=True) as opened:
        selected = {node.name: node for node in selected_nodes(opened.fleet, patterns, limit)}
        out = threading.Lock()

        def work(name: str) -> Outcome:
            with opened.access.borrow(selected[name]) as connection:
                done = connection.run(command, timeout_s=timeout)
            facts = {"exit_status": str(done.exit_status), "stdout": done.stdout, "stderr": done.stderr}
            with out:
                if raw:
                    echo_bytes(done.stdout_bytes)
                    echo_bytes(done.stderr_bytes, err=True)
                else:
                    _print(name, done.stdout, done.stderr, as_json=as_json, status=done.exit_status)
            result = Result.DONE if done.exit_status == 0 else Result.FAILED
            return Outcome(
                name, result, "" if done.exit_status == 0 else f"exit status {done.exit_status}", facts=facts
            )

        with opened.interrupt.on_signals(echo_error):
            ended = run_on_all(
                selected, work, parallel=transfers_at_once(opened.fleet.apply.parallel), interrupt=opened.interrupt
            )
        for outcome in ended.values():
            if not outcome.result.is_good and "exit_status" not in outcome.facts:
                if as_json:
                    echo_json(json.dumps({"node": outcome.node, "error": outcome.reason}))
                else:
                    echo(str(outcome), err=True)
                    if outcome.hint:
                        echo(f"  hint: {outcome.hint}", err=True)
        raise typer.Exit(exit_for(ended.values(), opened.interrupt))


def _split(words: list[str]) -> tuple[list[str], str]:
    """Split `b01 b02 -- CMD`. click drops the `--`, so it is looked up in sys.argv."""
    given = sys.argv[1:]
    if "--" not in given:
        raise InputError("expected `--` before the command", hint="meshctl run b01 -- uptime")
    command = given[given.index("--") + 1 :]
    if not command or words[-len(command) :] != command:
        raise InputError("expected a command after `--`", hint="meshctl run b01 -- uptime")
    return words[: -len(command)], command_line(command)


def _print(name: str, stdout: str, stderr: str, *, as_json: bool, status: int) -> None:
    if as_json:
        echo_json(json.dumps({"node": name, "exit_status": status, "stdout": stdout, "stderr": stderr}))
        return
    for line in stdout.splitlines():
        echo(f"{name}: {line}")
    for line in stderr.splitlines():
        echo(f"{name}: {line}", err=True)
    if status:
        echo(f"{name}: exit status {status}", err=True)


def ssh(
    node: OneNode,
    command: Annotated[list[str] | None, typer.Argument(help="After --: command to run instead of a shell.")] = None,
    inventory: InventoryPath = Path(),
    key: KeyFiles = None,
    lab: Lab = None,
) -> None:
    """Log in to a node with the system's ssh and the fleet's pinned host keys. Commands are quoted as for `run`.

    Exit code: that of ssh.

    Example: meshctl ssh b03

    Example: meshctl ssh b03 -- logread -f
    """
    program = shutil.which("ssh")
    if program is None:
        raise InputError("ssh is not installed", hint="install openssh-client")
    with session(inventory, key_files=key or (), lab=lab, changes_nothing=True) as opened:
        there = selected_node(opened.fleet, node)
        arguments = ssh_arguments(opened, there)
    os.execv(program, [*arguments, *([command_line(command)] if command else [])])


def ssh_arguments(opened: Session, node: Node) -> list[str]:
    """The OpenSSH command line for a node, with the fleet's pinned host keys, its keys and its jump host."""
    access = opened.access
    end = access.endpoint(node)
    arguments = ["ssh", "-p", str(end.port), "-o", f"UserKnownHostsFile={opened.trust.path}"]
    arguments += ["-o", f"HostKeyAlias={node.name}", "-o", "StrictHostKeyChecking=yes"]
    for path in access.credentials(node).key_files:
        arguments += ["-i", str(path)]
    hop: list[str] = []
    if node.ssh.jump:
        jump = opened.fleet.nodes[node.ssh.jump]
        through = replace(jump, ssh=replace(jump.ssh, jump=""))
        hop = ssh_arguments(opened, through)
    elif (site := opened.fleet.gateway_site(node)) is not None:
        hop = _gateway_arguments(opened, site)
    if hop:
        arguments += ["-o", f"ProxyCommand={shlex.join([*hop[:-1], '-W', '[%h]:%p', hop[-1]])}"]
    return [*arguments, _login(opened, node)]


def _gateway_arguments(opened: Session, site: Site) -> list[str]:
    """The OpenSSH command line for a site's gateway, with the fleet's pinned host keys."""
    end, access = gateway_endpoint(site), opened.access
    arguments = ["ssh", "-p", str(end.port), "-o", f"UserKnownHostsFile={opened.trust.path}"]
    arguments += ["-o", f"HostKeyAlias={end.identity}", "-o", "StrictHostKeyChecking=yes"]
    for path in gateway_credentials(opened.fleet, site, access.key_files, use_agent=access.use_agent).key_files:
        arguments += ["-i", str(path)]
    return [*arguments, f"{end.user}@{end.host}"]


def _login(opened: Session, node: Node) -> str:
    end = opened.access.endpoint(node)
    return f"{end.user}@{end.host}"
