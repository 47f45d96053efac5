"""`meshctl bootstrap` and `meshctl replace`: devices on the bench."""

from __future__ import annotations

import json
import os
import secrets
import socket
from collections.abc import Mapping
from dataclasses import replace as with_changes
from pathlib import Path
from typing import Annotated, Any

import typer

from meshctl.apply.bootstrap import (
    FACTORY_ADDRESS,
    BenchTarget,
    FoundDevice,
    discover,
    find_node,
    plan_discovered,
    restore_pins,
)
from meshctl.apply.replace import adopt, identity_edits, with_identity
from meshctl.cli.context import KeyFiles, Lab, Session, exit_for, session
from meshctl.cli.journaled_run import SALT_BYTES, ask_and_carry_out, choices_of
from meshctl.cli.options import AsJson, InventoryPath
from meshctl.cli.output import complain, echo
from meshctl.cli.plan import Brief, NoFirmware, Rate, Yes
from meshctl.errors import ExitCode, InputError, MeshctlError
from meshctl.fleet import Outcome, Result
from meshctl.inventory.edit import Change, Editor, save, set_node
from meshctl.model import Node, NodeState
from meshctl.plan import Verdict
from meshctl.report.progress import outcome_text

Changes = tuple[Change, ...]

# Stands for a device that is in no inventory yet.
BENCH = "bench"
SILENT_HINT = f"is it plugged in, on for a minute, and has this machine an address in {FACTORY_ADDRESS}'s network?"

At = Annotated[
    list[str] | None,
    typer.Option(
        "--at", help="Where a device answers, HOST or HOST:PORT, e.g. fe80::1%eth2; one for each NODE, in their order."
    ),
]

Interfaces = Annotated[
    list[str] | None,
    typer.Option(
        "--interface",
        help="An interface that one factory device is plugged into, e.g. eth1; one for each NODE, in their order.",
    ),
]


def bootstrap(
    nodes: Annotated[
        list[str] | None,
        typer.Argument(help="Whom to expect: name, label, serial number or MAC; default: whoever answers, by its MAC."),
    ] = None,
    at: At = None,
    interface: Interfaces = None,
    inventory: InventoryPath = Path(),
    replace_key: Annotated[
        bool, typer.Option("--replace-key", "--replace", help="Take a device whose host key is new.")
    ] = False,
    yes: Yes = False,
    no_firmware: NoFirmware = False,
    rate: Rate = None,
    brief: Brief = True,
    as_json: AsJson = False,
    key: KeyFiles = None,
    lab: Lab = None,
) -> None:
    """Take factory devices (root without a password at 192.168.1.1) into the fleet: identify, set keys, provision.

    Example: meshctl bootstrap b03 b04 --interface eth1 --interface eth2
    """
    choices = choices_of(no_firmware, "", "")
    with session(inventory, key_files=key or (), lab=lab) as opened:
        places = _places(opened, nodes or [], _spots(at or [], interface or []))
        with opened.interrupt.on_signals(complain):
            arrivals = discover(
                opened.renderer,
                opened.access,
                opened.trust,
                places,
                parallel=opened.fleet.apply.parallel,
                replace_keys=replace_key,
                interrupt=opened.interrupt,
            )
        for outcome in arrivals.outcomes:
            _complain(outcome)
        if not as_json:
            for name, item in arrivals.found.items():
                echo(f"{name}: found at {item.target.endpoint.label}, host key {item.key.fingerprint}")
        if not arrivals.found:
            raise typer.Exit(exit_for(arrivals.outcomes, opened.interrupt))
        prepared = plan_discovered(
            opened.renderer,
            opened.access,
            arrivals,
            opened.journal.last_known(opened.fleet.name),
            salt=secrets.token_bytes(SALT_BYTES),
            owner=opened.owner,
            choices=choices,
            interrupt=opened.interrupt,
        )
        refused = [plan.node for plan in prepared.plan.of(Verdict.REFUSED) if plan.node in arrivals.found]
        restore_pins(opened.trust, arrivals, refused)
        try:
            ask_and_carry_out(opened, prepared, "bootstrap", choices, yes=yes, as_json=as_json, brief=brief, rate=rate)
        except typer.Exit as ended:
            if arrivals.outcomes and ended.exit_code == ExitCode.OK:
                raise typer.Exit(ExitCode.FINDINGS) from None
            raise


def _complain(outcome: Outcome) -> None:
    echo(f"{outcome_text(outcome)}", err=True)
    is_silent = outcome.result is Result.UNREACHABLE and FACTORY_ADDRESS in outcome.node
    hint = outcome.hint or (SILENT_HINT if is_silent else "")
    if hint:
        echo(f"  hint: {hint}", err=True)


def _spots(at: list[str], interfaces: list[str]) -> list[BenchTarget]:
    """The places that were named, each by an address or by an interface."""
    if at and interfaces:
        raise InputError("expected --at or --interface, found both")
    if doubles := sorted({name for name in interfaces if interfaces.count(name) > 1}):
        raise InputError(f"--interface {doubles[0]} was given twice: one device answers on each")
    known = {name for _, name in socket.if_nameindex()}
    for name in interfaces:
        if name not in known:
            raise InputError(f"--interface {name}: there is none here, found {', '.join(sorted(known))}")
    return [_place(text) for text in at] + [BenchTarget(interface=name) for name in interfaces]


def _places(opened: Session, words: list[str], at: list[BenchTarget]) -> list[BenchTarget]:
    """Who is expected where."""
    if opened.lab is not None and not at:
        known = set(opened.lab.node_names)
        names = [find_node(opened.fleet, word).name for word in words]
        names = names or [node.name for node in opened.fleet.managed() if node.name in known]
        ends = {name: opened.lab.bench_endpoint(name) for name in names}
        return [BenchTarget(end.host, end.port, name) for name, end in ends.items()]
    expected = [find_node(opened.fleet, word).name for word in words]
    if not at:
        if len(expected) > 1:
            raise InputError(
                f"{len(expected)} nodes cannot all answer at one address",
                hint="one at a time, or say where each is plugged in: --interface eth1 --interface eth2",
            )
        return [BenchTarget(node=expected[0] if expected else "")]
    if expected and len(expected) != len(at):
        raise InputError(f"{len(expected)} nodes and {len(at)} places: expected as many places as nodes")
    names = expected or [""] * len(at)
    return [with_changes(place, node=name) for place, name in zip(at, names, strict=True)]


def _place(text: str) -> BenchTarget:
    """`HOST`, `HOST:PORT` or `[v6]:PORT`; a bare IPv6 address holds colons of its own."""
    host, colon, port = text.rpartition(":")
    if not colon or (text.count(":") > 1 and not text.startswith("[")):
        return BenchTarget(text)
    if not port.isdecimal() or not 0 < int(port) < 65536:
        raise InputError(f"--at {text}: expected HOST or HOST:PORT")
    return BenchTarget(host.strip("[]"), int(port))


def replace(
    old: Annotated[str, typer.Argument(help="The node whose device is dead or gone.")],
    new: Annotated[str, typer.Argument(help="A spare of the inventory; `bench` for a device that is in none.")],
    at: Annotated[
        str, typer.Option("--at", help="Where the new device answers, if not at its own address: HOST or HOST:PORT.")
    ] = "",
    interface: Annotated[
        str, typer.Option("--interface", help="The interface that a factory device is plugged into, e.g. eth1.")
    ] = "",
    inventory: InventoryPath = Path(),
    yes: Yes = False,
    no_firmware: NoFirmware = False,
    rate: Rate = None,
    as_json: AsJson = False,
    key: KeyFiles = None,
    lab: Lab = None,
) -> None:
    """Give a dead node's identity to a spare: same name, address and role; the inventory learns its MAC and label.

    Example: meshctl replace husky1-b03 spare2
    """
    choices = choices_of(no_firmware, "", "")
    with session(inventory, key_files=key or (), lab=lab) as opened:
        node = find_node(opened.fleet, old)
        spare = _spare(opened, node, new)
        spots = _spots([at] if at else [], [interface] if interface else []) or [BenchTarget()][: spare is None]
        place = with_changes(spots[0], node=node.name) if spots else None
        fleet = with_identity(opened.fleet, node, spare)
        opened = with_changes(opened, fleet=fleet, renderer=with_changes(opened.renderer, fleet=fleet))
        node = fleet.nodes[node.name]
        with opened.interrupt.on_signals(complain):
            successor = adopt(
                opened.renderer,
                opened.access,
                opened.trust,
                node,
                spare=spare,
                target=place,
                interrupt=opened.interrupt,
            )
        if not as_json:
            echo(_who_becomes_whom(node, spare, new, successor.discovered.found.get(node.name)))
        status = int(ExitCode.FINDINGS)
        try:
            prepared = plan_discovered(
                opened.renderer,
                opened.access,
                successor.discovered,
                opened.journal.last_known(opened.fleet.name),
                salt=secrets.token_bytes(SALT_BYTES),
                owner=opened.owner,
                choices=choices,
                interrupt=opened.interrupt,
            )
            ask_and_carry_out(opened, prepared, "replace", choices, yes=yes, as_json=as_json, brief=True, rate=rate)
        except typer.Exit as ended:
            status = ended.exit_code
        finally:
            if status != ExitCode.OK:
                restore_pins(opened.trust, successor.discovered, [node.name])
        if status == ExitCode.OK:
            changes = _learn_identity(opened, inventory, node, spare, successor.discovered.found[node.name])
            echo("".join(change.diff() for change in changes), nl=False, err=as_json)
        raise typer.Exit(status)


def _who_becomes_whom(node: Node, spare: Node | None, new: str, found: FoundDevice | None) -> str:
    """`spare2, found at 192.168.1.1, becomes husky1-b03 (10.42.0.13): its name, address and role; ...`."""
    there = f", found at {found.target.endpoint.label}," if found is not None else ""
    who = spare.name if spare is not None else f"the device on the {new}"
    left = f"; the entry {spare.name} is retired" if spare is not None else ""
    return f"{who}{there} becomes {node.name} ({node.address.ip}): its name, address and role{left}"


def _spare(opened: Session, old: Node, new: str) -> Node | None:
    """None for a device that is in no inventory."""
    if new == BENCH:
        return None
    spare = find_node(opened.fleet, new)
    if spare.name == old.name:
        raise InputError(f"{spare.name} cannot take over from itself")
    if spare.state is not NodeState.SPARE:
        hint = f"`meshctl inventory state {spare.name} spare`, if it is one"
        raise InputError(f"{spare.name} is {spare.state.value}: expected a spare", hint=hint)
    return spare


def _learn_identity(opened: Session, inventory: Path, node: Node, spare: Node | None, found: FoundDevice) -> Changes:
    """Into the inventory and the pins. Raises InputError that says what to write there, when it cannot be written."""
    mine, theirs = identity_edits(node, spare, found.seen)
    if spare is not None:
        opened.trust.forget(spare.name)
    try:
        return _write_identity(inventory, node, spare, found, mine, theirs)
    except MeshctlError as error:
        both = {node.name: dict(mine), **({spare.name: dict(theirs)} if spare is not None else {})}
        edits = {name: edit for name, edit in both.items() if edit}
        raise InputError(
            f"{node.name} runs on its new device, but the inventory could not learn of it: {error}",
            hint=f"mend it, then write under `nodes`: {json.dumps(edits)}",
        ) from error


def _write_identity(
    inventory: Path,
    node: Node,
    spare: Node | None,
    found: FoundDevice,
    mine: Mapping[str, Any],
    theirs: Mapping[str, Any],
) -> Changes:
    editor = Editor.open(inventory, environ=os.environ)
    # the spare's entry first: two nodes with one MAC would be refused
    if spare is not None:
        set_node(editor, spare.name, dict(theirs))
        for word in ("mac", "serial", "label"):
            if editor.has(("nodes", spare.name, word)):
                editor.remove(("nodes", spare.name, word))
    if mine:
        set_node(editor, node.name, dict(mine))
    if node.host_keys:
        set_node(editor, node.name, {"host_keys": [found.key.text]})
    changes = editor.changes()
    save(changes)
    return changes
