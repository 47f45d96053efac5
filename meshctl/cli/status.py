"""`meshctl status`, `preflight` and `topology`: one look at the whole fleet, told three ways."""

from __future__ import annotations

import json
import time
from enum import Enum
from pathlib import Path
from typing import Annotated

import typer

from meshctl.apply.gather import known_macs
from meshctl.apply.planning import Choices, Prepared
from meshctl.cli.carry import prepared_for
from meshctl.cli.options import AsJson, InventoryPath
from meshctl.cli.session import KeyFiles, Lab, Nodes, Session, chosen, session
from meshctl.errors import ExitCode, InputError
from meshctl.fleet.journal import LastKnown
from meshctl.model import Backend, Node
from meshctl.status import FleetStatus, assess
from meshctl.status import preflight as checks_of
from meshctl.status.assess import Look
from meshctl.status.picture import FORMATS, Picture, directions
from meshctl.status.text import as_json as status_json
from meshctl.status.text import preflight_text, text
from meshctl.topology import report_of

_CLEAR = "\x1b[H\x1b[2J"


class Format(str, Enum):  # noqa: UP042 - typer shows the values of a str enum
    """How `meshctl topology` draws."""

    TABLE = "table"
    TREE = "tree"
    JSON = "json"
    NETJSON = "netjson"
    DOT = "dot"


def status(
    nodes: Nodes = None,
    inventory: InventoryPath = Path(),
    watch: Annotated[
        float | None, typer.Option("--watch", min=1.0, metavar="S", help="Look again every S seconds.")
    ] = None,
    as_json: AsJson = False,
    key: KeyFiles = None,
    lab: Lab = None,
) -> None:
    """Show every node: does it answer, is it as the inventory says, whom does it hear, what is wrong.

    Exit code: 0 all well, 1 something degraded, 3 a deployed node does not answer.

    Example: meshctl status --watch 5
    """
    with session(inventory, key_files=key or (), lab=lab) as opened:
        while True:
            found, _ = _look(opened, nodes)
            if as_json:
                typer.echo(json.dumps(status_json(found), indent=None if watch else 2))
            else:
                typer.echo((_CLEAR if watch else "") + text(found))
            if watch is None:
                raise typer.Exit(found.exit_code)
            time.sleep(watch)


def preflight(
    inventory: InventoryPath = Path(), as_json: AsJson = False, key: KeyFiles = None, lab: Lab = None
) -> None:
    """Go or no-go for the run: one line per check, with the reason. Exit code 0 go, 1 no-go.

    Example: meshctl preflight
    """
    with session(inventory, key_files=key or (), lab=lab) as opened:
        found, _ = _look(opened, None)
        checks = checks_of(opened.fleet, found)
    is_go = all(check.is_go for check in checks)
    if as_json:
        told = [{"check": check.name, "go": check.is_go, "reason": check.reason} for check in checks]
        typer.echo(json.dumps({"go": is_go, "checks": told}, indent=2))
    else:
        typer.echo(preflight_text(checks))
    raise typer.Exit(ExitCode.OK if is_go else ExitCode.FINDINGS)


def topology(
    mesh: Annotated[str, typer.Option("--mesh", help="Which mesh, where the fleet has several.")] = "",
    form: Annotated[Format, typer.Option("--format", "-f", help="How to draw it.")] = Format.TREE,
    inventory: InventoryPath = Path(),
    key: KeyFiles = None,
    lab: Lab = None,
) -> None:
    """Draw the mesh as its nodes see it: links with quality both ways, hops to the base, cut vertices marked.

    Example: meshctl topology --format dot | dot -Tsvg > mesh.svg
    """
    with session(inventory, key_files=key or (), lab=lab) as opened:
        fleet = opened.fleet
        if mesh and mesh not in fleet.meshes:
            raise InputError(f"no mesh of {fleet.name} is called {mesh!r}: it has {', '.join(fleet.meshes)}")
        names = {node.name for node in fleet.members(mesh)} if mesh else set(fleet.nodes)
        found, prepared = _look(opened, sorted(names & {node.name for node in fleet.managed()}))
        known = opened.journal.last_known(fleet.name)
        macs = known_macs(fleet, known)
        seen = prepared.seen
        reports = {name: report_of(name, one) for name, one in seen.observations.items()}
        for report in reports.values():
            macs.update(dict.fromkeys(report.macs, report.node))
        routing = next((m.backend for m in fleet.meshes.values() if m.name == mesh or not mesh), Backend.BATMAN)
        picture = Picture(
            mesh=mesh or fleet.name,
            entry=found.entry,
            graph=seen.graph(fleet, known),
            directions=directions(reports, macs),
            ages_s={
                node.name: node.age_s for node in found.nodes if node.age_s is not None and not node.silent_because
            },
            addresses={node.name: str(node.address.ip) for node in fleet.nodes.values()},
            routing=routing.value,
        )
        typer.echo(FORMATS[form.value](picture))


def _look(opened: Session, patterns: list[str] | None) -> tuple[FleetStatus, Prepared]:
    """Observe and compare; the status of the chosen nodes."""
    fleet = opened.fleet
    before: dict[str, LastKnown] = opened.journal.last_known(fleet.name)
    prepared = prepared_for(opened, patterns, Choices())
    seen = prepared.seen
    macs = known_macs(fleet, opened.journal.last_known(fleet.name))
    for report in seen.reports:
        macs.update(dict.fromkeys(report.macs, report.node))
    silent = {**seen.away, **{name: str(error) for name, error in seen.refused.items()}}
    look = Look(
        fleet=fleet,
        observations=seen.observations,
        silent=silent,
        plans=prepared.plan.nodes,
        graph=seen.graph(fleet, before),
        known=before,
        macs=macs,
        entry=prepared.plan.entry or _base_name(fleet.base_node),
        own_lock=opened.owner,
    )
    return assess(look, chosen(fleet, patterns), time.time()), prepared


def _base_name(node: Node | None) -> str:
    return node.name if node is not None else ""
