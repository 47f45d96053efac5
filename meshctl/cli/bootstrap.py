"""`meshctl bootstrap` and `meshctl replace`: set up devices on the bench."""

from __future__ import annotations

import json
import os
import secrets
import time
from collections.abc import Mapping
from contextlib import closing
from dataclasses import replace as with_changes
from pathlib import Path
from typing import Annotated, Any

import typer

from meshctl.apply.bootstrap import (
    BenchTarget,
    FoundDevice,
    discover,
    plan_discovered,
    restore_pins,
)
from meshctl.apply.prepare import PlanOptions
from meshctl.apply.replace import (
    Replacement,
    adopt,
    has_old_state,
    identity_edits,
    require_off,
    still_on,
    with_identity,
)
from meshctl.cli.bench_places import (
    At,
    AtSite,
    ExpectedNodes,
    Interfaces,
    named_places,
    no_answer_hint,
    places_in_lab,
    with_site,
)
from meshctl.cli.context import (
    AsJson,
    DryRun,
    InventoryPath,
    KeyFiles,
    Lab,
    Limit,
    Session,
    exit_for,
    selected_node,
    selected_nodes,
    session,
)
from meshctl.cli.fleet_view import site_observer
from meshctl.cli.node_completion import complete_node
from meshctl.cli.output import echo, echo_error
from meshctl.cli.plan import Brief, NoFirmware, Rate, Yes
from meshctl.cli.plan_execution import SALT_BYTES, confirm_and_execute
from meshctl.device.observation import Observation
from meshctl.errors import ExitCode, InputError, MeshctlError, NodeError
from meshctl.fleet import Outcome, Result
from meshctl.inventory.edit import Editor, FileEdit, save, set_node
from meshctl.model import Fleet, Node, NodeState
from meshctl.nodes.former_devices import facts_of_former_device
from meshctl.nodes.slots import transfers_at_once
from meshctl.plan import Verdict
from meshctl.report.progress import outcome_text

Changes = tuple[FileEdit, ...]

# Argument for a device that is not in the inventory.
BENCH = "bench"


def bootstrap(
    nodes: ExpectedNodes = None,
    limit: Limit = None,
    at: At = None,
    interface: Interfaces = None,
    at_site: AtSite = "",
    inventory: InventoryPath = Path(),
    replace_key: Annotated[bool, typer.Option("--replace-key", "--replace", help="Accept a changed host key.")] = False,
    dry_run: DryRun = False,
    yes: Yes = False,
    no_firmware: NoFirmware = False,
    rate: Rate = None,
    brief: Brief = True,
    as_json: AsJson = False,
    key: KeyFiles = None,
    lab: Lab = None,
) -> None:
    """Set up factory-default devices (192.168.1.1, root without password): identify, install keys, provision.

    Example: meshctl bootstrap b03 b04 --interface eth1 --interface eth2

    Example: meshctl bootstrap b03 --at-site north
    """
    choices = PlanOptions(with_firmware=not no_firmware)
    with session(inventory, key_files=key or (), lab=lab, changes_nothing=dry_run) as opened:
        given = _given_places(opened, at or [], interface or [], at_site)
        places = _expected_places(opened, nodes or [], limit or [], given)
        places = [with_site(opened.fleet, place, at_site) for place in places]
        with opened.interrupt.on_signals(echo_error):
            arrivals = discover(
                opened.renderer,
                opened.access,
                opened.trust,
                places,
                parallel=transfers_at_once(opened.fleet.apply.parallel),
                replace_keys=replace_key,
                interrupt=opened.interrupt,
            )
        for outcome in arrivals.outcomes:
            _print_failure(outcome, opened, next((place for place in places if str(place) == outcome.node), None))
        if not as_json:
            for name, item in arrivals.found.items():
                echo(f"{name}: found at {item.target.label}, host key {item.key.fingerprint}")
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
        restore_pins(opened.trust, arrivals, arrivals.found if dry_run else refused)
        try:
            confirm_and_execute(
                opened,
                prepared,
                "bootstrap",
                choices,
                yes=yes,
                as_json=as_json,
                brief=brief,
                rate=rate,
                dry_run=dry_run,
            )
        except typer.Exit as ended:
            if arrivals.outcomes and ended.exit_code == ExitCode.OK:
                raise typer.Exit(ExitCode.FINDINGS) from None
            raise


def _print_failure(outcome: Outcome, opened: Session, place: BenchTarget | None) -> None:
    echo(f"{outcome_text(outcome)}", err=True)
    hint = outcome.hint
    if not hint and outcome.result is Result.UNREACHABLE and place is not None:
        node = opened.fleet.nodes.get(place.node)
        hint = no_answer_hint(
            place,
            node,
            is_pinned=node is not None and bool(opened.trust.pinned(node.name)),
            is_unfinished=place.node in opened.journal.unfinished_changes(opened.fleet.name),
        )
    if hint:
        echo(f"  hint: {hint}", err=True)


def _given_places(opened: Session, at: list[str], interfaces: list[str], site: str) -> list[BenchTarget]:
    """The places of --at or --interface; in a lab those of its nodes."""
    places = named_places(at, interfaces, site)
    return places if opened.lab is None else places_in_lab(places, opened.lab)


def _expected_places(opened: Session, words: list[str], limits: list[str], at: list[BenchTarget]) -> list[BenchTarget]:
    """The places, each with the node expected there."""
    selected = selected_nodes(opened.fleet, words, limits, in_word_order=True) if words or limits else ()
    expected = [node.name for node in selected]
    if opened.lab is not None and not at:
        known = set(opened.lab.node_names)
        names = expected or [node.name for node in opened.fleet.managed() if node.name in known]
        ends = {name: opened.lab.bench_endpoint(name) for name in names}
        return [BenchTarget(end.host, end.port, name) for name, end in ends.items()]
    if not at:
        if len(expected) > 1:
            raise InputError(
                f"{len(expected)} nodes cannot share one address",
                hint="bootstrap one at a time, or give each interface: --interface eth1 --interface eth2",
            )
        return [BenchTarget(node=expected[0] if expected else "")]
    if expected and len(expected) != len(at):
        raise InputError(f"expected one --at or --interface per node, found {len(at)} for {len(expected)} nodes")
    names = expected or [""] * len(at)
    return [with_changes(place, node=name) for place, name in zip(at, names, strict=True)]


def replace(
    old: Annotated[str, typer.Argument(help="Node whose device failed or is lost.", autocompletion=complete_node)],
    new: Annotated[str, typer.Argument(help="Spare node, or `bench` for a device that is not in the inventory.")],
    at: Annotated[
        str,
        typer.Option(
            "--at",
            metavar="HOST",
            help="Address of the new device, if it is not the spare's own: HOST or HOST:PORT; in a lab a virtual node.",
        ),
    ] = "",
    interface: Annotated[
        str, typer.Option("--interface", metavar="IF", help="Interface with the factory-default device, e.g. eth1.")
    ] = "",
    at_site: AtSite = "",
    inventory: InventoryPath = Path(),
    old_is_off: Annotated[
        bool,
        typer.Option(
            "--old-is-off", help="Do not check whether the old device still answers: its site is unreachable."
        ),
    ] = False,
    dry_run: DryRun = False,
    yes: Yes = False,
    no_firmware: NoFirmware = False,
    rate: Rate = None,
    as_json: AsJson = False,
    key: KeyFiles = None,
    lab: Lab = None,
) -> None:
    """Replace a failed node: the new device gets its name, address and role; its MAC and label go into the inventory.

    Example: meshctl replace husky1-b03 spare2
    """
    choices = PlanOptions(with_firmware=not no_firmware)
    with session(inventory, key_files=key or (), lab=lab, changes_nothing=dry_run) as opened:
        old_node = _replaced(opened.fleet, old)
        spare = _spare(opened, old_node, new)
        former = facts_of_former_device(old_node, opened.journal.last_known(opened.fleet.name))
        has_taken_over = not old_is_off and _require_off(opened, inventory, old_node, spare)
        given = _given_places(opened, [at] if at else [], [interface] if interface else [], at_site)
        if spare is None and not given and opened.lab is not None:
            raise InputError(
                "every virtual node has a bench port of its own: expected --at NODE",
                hint=f"for example: --at {opened.lab.node_names[-1]}",
            )
        spots = given or [BenchTarget()][: spare is None or at_site != ""]
        place = with_site(opened.fleet, with_changes(spots[0], node=old_node.name), at_site) if spots else None
        if has_taken_over:
            place = None
        fleet = with_identity(opened.fleet, old_node, spare)
        opened = with_changes(opened, fleet=fleet, renderer=with_changes(opened.renderer, fleet=fleet))
        node = fleet.nodes[old_node.name]
        with opened.interrupt.on_signals(echo_error):
            successor = adopt(
                opened.renderer,
                opened.access,
                opened.trust,
                node,
                spare=spare,
                target=place,
                has_taken_over=has_taken_over,
                interrupt=opened.interrupt,
            )
        if not as_json:
            echo(_replacement_text(node, spare, new, successor.discovered.found.get(node.name)))
        ended: dict[str, Outcome] = {}
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
            confirm_and_execute(
                opened,
                prepared,
                "replace",
                choices,
                yes=yes,
                as_json=as_json,
                brief=True,
                rate=rate,
                dry_run=dry_run,
                on_outcomes=ended.update,
            )
        except typer.Exit as exited:
            status = exited.exit_code
        finally:
            if node.name not in ended or has_old_state(ended[node.name].result):
                successor.put_back_pins(opened.trust)
        # not by the exit code: after Ctrl-C the device may have taken over, too
        has_succeeded = status == ExitCode.OK if dry_run else ended[node.name].result.is_good
        if has_succeeded:
            if former[1] and not (dry_run or has_taken_over):
                opened.journal.remember(opened.fleet.name, *former, time.time())
            changes = _record_identity(opened, inventory, old_node, spare, successor, dry_run=dry_run)
            echo("".join(change.diff() for change in changes), nl=False, err=as_json)
        raise typer.Exit(status)


def _replacement_text(node: Node, spare: Node | None, new: str, found: FoundDevice | None) -> str:
    """`spare2, found at 192.168.1.1, becomes husky1-b03 (10.42.0.13): its name, address and role; ...`."""
    there = f", found at {found.target.label}," if found is not None else ""
    who = spare.name if spare is not None else f"the device on the {new}"
    left = f"; {spare.name} is retired" if spare is not None else ""
    return f"{who}{there} becomes {node.name} ({node.address.ip}): its name, address and role{left}"


def _replaced(fleet: Fleet, word: str) -> Node:
    """The node that gets another device: in use, or lost."""
    node = selected_node(fleet, word, with_unmanaged=True)
    if node.state is NodeState.RETIRED:
        hint = f"to use its name again, run `meshctl inventory state {node.name} deployed`"
        raise InputError(f"{node.name} is retired: expected a node that is in use or lost", hint=hint)
    return node


def _require_off(opened: Session, inventory: Path, old: Node, spare: Node | None) -> bool:
    """Whether the spare has already taken over. Raises NodeError if the old device answers, or if its site cannot be
    asked."""
    try:
        if opened.fleet.gateway_site(old) is None and (observer := site_observer(opened, inventory)) is not None:
            with closing(observer):
                if site := observer.site_of(old):
                    if isinstance(observer.observe(site, [old.name]).get(old.name), Observation):
                        raise still_on(old, f"site {site}")
                    return False
        return require_off(opened.access, opened.trust, old, spare)
    except NodeError as error:
        if error.gateway_of:
            hint = f"pass --old-is-off if you know that it is{f'; {error.hint}' if error.hint else ''}"
            raise NodeError(f"cannot determine whether {old.name} is off: {error}", hint=hint) from error
        raise


def _spare(opened: Session, old: Node, new: str) -> Node | None:
    """The spare node; None for a device that is not in the inventory."""
    if new == BENCH:
        return None
    spare = selected_node(opened.fleet, new, with_unmanaged=True)
    if spare.name == old.name:
        raise InputError(f"{spare.name} cannot replace itself")
    if spare.state is not NodeState.SPARE:
        hint = f"if it is a spare, run `meshctl inventory state {spare.name} spare`"
        raise InputError(f"{spare.name} is {spare.state.value}: expected a spare", hint=hint)
    return spare


def _record_identity(
    opened: Session, inventory: Path, node: Node, spare: Node | None, successor: Replacement, *, dry_run: bool
) -> Changes:
    """Write the new identity to the inventory. Raises InputError with the edits to make by hand if that fails."""
    found = successor.discovered.found[node.name]
    node_edits, spare_edits = identity_edits(node, spare, found.observation)
    if dry_run:
        return _identity_changes(inventory, node, spare, found, node_edits, spare_edits)
    opened.trust.replace(node.name, found.key)
    try:
        changes = _identity_changes(inventory, node, spare, found, node_edits, spare_edits)
        save(changes)
    except MeshctlError as error:
        both = {node.name: dict(node_edits), **({spare.name: dict(spare_edits)} if spare is not None else {})}
        edits = {name: edit for name, edit in both.items() if edit}
        raise InputError(
            f"{node.name} runs on its new device, but the inventory could not be updated: {error}",
            hint=f"fix the inventory, then repeat the command, or add under `nodes`: {json.dumps(edits)}",
        ) from error
    # last: by it, a repeated command knows the device that has taken over
    opened.trust.forget(successor.new_name)
    return changes


def _identity_changes(
    inventory: Path,
    node: Node,
    spare: Node | None,
    found: FoundDevice,
    node_edits: Mapping[str, Any],
    spare_edits: Mapping[str, Any],
) -> Changes:
    editor = Editor.open(inventory, environ=os.environ)
    # the spare's entry first: two nodes must not share a MAC
    if spare is not None:
        set_node(editor, spare.name, dict(spare_edits))
        for word in ("mac", "serial", "label"):
            if editor.has(("nodes", spare.name, word)):
                editor.remove(("nodes", spare.name, word))
    # the old device's values: another device may have them one day, and this one's are observed
    for radio in node.radios:
        if editor.has(("nodes", node.name, "radios", radio.name, "mac")):
            editor.remove(("nodes", node.name, "radios", radio.name, "mac"))
    if node_edits:
        set_node(editor, node.name, dict(node_edits))
    if node.host_keys:
        set_node(editor, node.name, {"host_keys": [found.key.text]})
    return editor.changes()
