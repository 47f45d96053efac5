"""`meshctl trust`, `run`, `ssh`: reach nodes with the fleet's own keys and pins."""

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

from meshctl.cli.context import KeyFiles, Lab, Nodes, Session, chosen, exit_for, session
from meshctl.cli.options import AsJson, InventoryPath
from meshctl.cli.output import complain, echo, echo_bytes, echo_json
from meshctl.errors import ExitCode, InputError
from meshctl.fleet import Outcome, Result
from meshctl.fleet import run as run_on_all
from meshctl.model import Node
from meshctl.nodes.host_keys import HostKeyState, fetch_host_keys


def trust(
    nodes: Nodes = None,
    inventory: InventoryPath = Path(),
    change: Annotated[
        bool, typer.Option("--replace", "--replace-key", help="Also take keys that differ from the pinned ones.")
    ] = False,
    yes: Annotated[
        bool, typer.Option("--yes", "-y", help="Pin without asking; compare the fingerprints first.")
    ] = False,
    as_json: AsJson = False,
    key: KeyFiles = None,
    lab: Lab = None,
) -> None:
    """Show the nodes' host key fingerprints, ask, and pin them in the fleet's known_hosts.

    Example: meshctl trust b03
    """
    with session(inventory, key_files=key or (), lab=lab) as opened:
        shown = fetch_host_keys(
            opened.access, opened.trust, chosen(opened.fleet, nodes), parallel=opened.fleet.apply.parallel
        )
        if as_json:
            echo_json(json.dumps([_key_object(item) for item in shown], indent=1))
        left = 0
        for item in shown:
            left += not _decide(opened, item, may_replace=change, yes=yes, quiet=as_json)
        if left:
            silent = all(item.key is None for item in shown)
            raise typer.Exit(ExitCode.UNREACHABLE if silent else ExitCode.FINDINGS)


def _key_object(item: HostKeyState) -> dict[str, str]:
    return {
        "node": item.node.name,
        "state": item.state,
        "key_type": item.key.key_type if item.key else "",
        "fingerprint": item.key.fingerprint if item.key else "",
    }


def _decide(opened: Session, item: HostKeyState, *, may_replace: bool, yes: bool, quiet: bool) -> bool:
    """Tell, ask, pin; whether the node's key is pinned in the end."""

    def say(text: str) -> None:
        if not quiet:
            echo(text)

    name = item.node.name
    if item.key is None:
        say(f"{name}: {item.error}")
        return False
    line = f"{name}: {item.key.fingerprint} ({item.key.key_type})"
    if item.is_pinned:
        say(f"{line}: pinned")
        return True
    if item.is_changed:
        say(f"{line}: DIFFERS from the pinned {', '.join(item.pinned)}")
        if not may_replace:
            say("  hint: another device, a flash meshctl did not do, or an attack; --replace once you know which")
            return False
    else:
        say(f"{line}: not pinned yet")
    if not yes:
        if quiet or not sys.stdin.isatty():
            return False
        if not typer.confirm("  Is this what the node itself shows?"):
            return False
    opened.trust.replace(name, item.key)
    say(f"{line}: pinned now")
    return True


def run(
    words: Annotated[
        list[str],
        typer.Argument(
            metavar="NODES -- COMMAND",
            help="Nodes or patterns, then -- and the command; without nodes: on all.",
        ),
    ],
    inventory: InventoryPath = Path(),
    timeout: Annotated[float, typer.Option("--timeout", help="Seconds that a node may take.")] = 60.0,
    raw: Annotated[
        bool, typer.Option("--raw", help="Pass the output through as it is: no names, control characters included.")
    ] = False,
    as_json: AsJson = False,
    key: KeyFiles = None,
    lab: Lab = None,
) -> None:
    """Run a shell command on nodes, in parallel.

    One word after -- goes to the node's shell as it stands: quote it once for your own shell, and pipes and variables
    are the node's. Several words arrive there as these words, without expansion.

    Exit code: 0 when it ends with 0 on every node, else 1; 3 when no node answers.

    Example: meshctl run 'husky*' -- uptime

    Example: meshctl run b01 b02 -- 'logread | grep -c batman'
    """
    if raw and as_json:
        raise InputError("expected --raw or --json, found both")
    patterns, command = _split(words)
    with session(inventory, key_files=key or (), lab=lab) as opened:
        wanted = {node.name: node for node in chosen(opened.fleet, patterns)}
        out = threading.Lock()

        def work(name: str) -> Outcome:
            with opened.access.borrow(wanted[name]) as connection:
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

        with opened.interrupt.on_signals(complain):
            ended = run_on_all(wanted, work, parallel=opened.fleet.apply.parallel, interrupt=opened.interrupt)
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
    """`b01 b02 -- CMD` or `-- CMD`. What click leaves of `--` is looked up in the process's own arguments."""
    given = sys.argv[1:]
    if "--" not in given:
        raise InputError("expected `--` before the command", hint="meshctl run b01 -- uptime")
    command = given[given.index("--") + 1 :]
    if not command or words[-len(command) :] != command:
        raise InputError("expected a command after `--`", hint="meshctl run b01 -- uptime")
    return words[: -len(command)], shell_words(command)


def shell_words(command: list[str]) -> str:
    """What the node's shell gets: one word as it stands, several so that each arrives as one."""
    return command[0] if len(command) == 1 else shlex.join(command)


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
    node: Annotated[str, typer.Argument(help="Name of the node.")],
    command: Annotated[
        list[str] | None, typer.Argument(help="After --: a command to run there instead of a shell.")
    ] = None,
    inventory: InventoryPath = Path(),
    key: KeyFiles = None,
    lab: Lab = None,
) -> None:
    """Log in to a node with the system's ssh, trusting what the fleet trusts. A command is quoted as for `run`.

    Exit code: that of ssh.

    Example: meshctl ssh b03

    Example: meshctl ssh b03 -- logread -f
    """
    program = shutil.which("ssh")
    if program is None:
        raise InputError("there is no ssh on this machine", hint="install openssh-client")
    with session(inventory, key_files=key or (), lab=lab) as opened:
        (there,) = chosen(opened.fleet, [node])[:1]
        arguments = ssh_arguments(opened, there)
    os.execv(program, [*arguments, *([shell_words(command)] if command else [])])


def ssh_arguments(opened: Session, node: Node) -> list[str]:
    """The command line of OpenSSH for a node: the fleet's pins under the node's name, its keys, its jump."""
    access = opened.access
    end = access.endpoint(node)
    arguments = ["ssh", "-p", str(end.port), "-o", f"UserKnownHostsFile={opened.trust.path}"]
    arguments += ["-o", f"HostKeyAlias={node.name}", "-o", "StrictHostKeyChecking=yes"]
    for path in access.credentials(node).key_files:
        arguments += ["-i", str(path)]
    if node.ssh.jump:
        through = replace(opened.fleet.nodes[node.ssh.jump], ssh=replace(node.ssh, jump=""))
        hop = [*ssh_arguments(opened, through)[:-1], "-W", "%h:%p", _login(opened, through)]
        arguments += ["-o", f"ProxyCommand={shlex.join(hop)}"]
    return [*arguments, _login(opened, node)]


def _login(opened: Session, node: Node) -> str:
    end = opened.access.endpoint(node)
    return f"{end.user}@{end.host}"
