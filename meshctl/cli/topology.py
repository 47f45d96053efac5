"""`meshctl topology`: the mesh topology as its nodes report it."""

from __future__ import annotations

import sys
import time
from enum import Enum
from pathlib import Path
from typing import Annotated

import typer

from meshctl.cli.context import InventoryPath, KeyFiles, Lab, Limit, Nodes, selected_nodes
from meshctl.cli.fleet_view import CONNECT_S, Direct, Timeout, collect, open_fleet_view
from meshctl.cli.output import echo, echo_error, terminal_width
from meshctl.errors import ExitCode, InputError
from meshctl.model import Backend
from meshctl.status import assess
from meshctl.status.topology_formats import FORMATS, TopologyView, directions, table, tree
from meshctl.suggest import did_you_mean
from meshctl.topology import observed_graph
from meshctl.topology.cells import link_cells, mesh_reports


class TopologyFormat(str, Enum):  # noqa: UP042 - typer shows the values of a str enum
    """Output format of `meshctl topology`."""

    TABLE = "table"
    TREE = "tree"
    JSON = "json"
    NETJSON = "netjson"
    DOT = "dot"


def topology(
    nodes: Nodes = None,
    limit: Limit = None,
    mesh: Annotated[str, typer.Option("--mesh", help="Mesh to show if the fleet has several.")] = "",
    form: Annotated[TopologyFormat, typer.Option("--format", "-f", help="Output format.")] = TopologyFormat.TREE,
    inventory: InventoryPath = Path(),
    direct: Direct = False,
    timeout: Timeout = CONNECT_S,
    as_json: Annotated[bool, typer.Option("--json", help="Same as --format json.")] = False,
    key: KeyFiles = None,
    lab: Lab = None,
) -> None:
    """Show the mesh topology: links with quality in both directions, hops to the base, and cut vertices.

    With a selection, only those nodes are queried: links that only others report are missing.

    Exit code: 0 success, 3 no node answered, 2 could not run.

    Example: meshctl topology --format dot | dot -Tsvg > mesh.svg
    """
    with open_fleet_view(inventory, key=key, lab=lab, timeout=timeout, no_robots=True, direct=direct) as fleet_view:
        fleet = fleet_view.fleet
        if mesh and mesh not in fleet.meshes:
            hint = did_you_mean(mesh, fleet.meshes) or f"its meshes are {', '.join(fleet.meshes)}"
            raise InputError(f"{fleet.name} has no mesh {mesh!r}", hint=hint)
        names = {node.name for node in fleet.members(mesh)} if mesh else set(fleet.nodes)
        queried = tuple(node for node in selected_nodes(fleet, nodes, limit) if node.name in names)
        snapshot = collect(fleet_view, queried)
        found = assess(snapshot, queried, time.time())
    if mesh:
        reports = mesh_reports(fleet, snapshot.observations, mesh)
        wires = [(link.a, link.b) for link in snapshot.graph.links if link.wired]
        graph = observed_graph(reports.values(), known_macs=snapshot.macs, wires=wires)
    else:
        reports = dict(snapshot.reports)
        graph = snapshot.graph
    routing = next((m.backend for m in fleet.meshes.values() if m.name == mesh or not mesh), Backend.BATMAN)
    view = TopologyView(
        mesh=mesh or fleet.name,
        entries=snapshot.entries,
        graph=graph,
        directions=directions(reports, snapshot.macs),
        ages_s={node.name: node.age_s for node in found.nodes if node.age_s is not None and not node.no_answer_reason},
        addresses={node.name: str(node.address.ip) for node in fleet.nodes.values()},
        routing=routing.value,
        cells=link_cells(fleet, snapshot.observations, snapshot.macs, (mesh,) if mesh else fleet.meshes),
        queried=frozenset(node.name for node in queried) if nodes or limit else None,
    )
    for_people = {TopologyFormat.TABLE: table, TopologyFormat.TREE: tree}
    if form in for_people and not as_json:
        drawn = for_people[form](view, terminal_width(sys.stdout))
    else:
        drawn = FORMATS["json" if as_json else form.value](view)
    if drawn:
        echo(drawn)
    if not snapshot.observations:
        is_new = bool(queried) and all(node.age_s is None for node in found.nodes)
        why = (
            "no node has ever answered; run `meshctl bootstrap` to set up factory-default devices"
            if is_new
            else "run `meshctl status` for the reason"
        )
        echo_error(f"no node answered: {why}")
    elif apart := [node.name for node in queried if node.name not in graph]:
        echo_error(f"no node reports {', '.join(apart)}; run `meshctl status` for the reason")
    raise typer.Exit(ExitCode.OK if snapshot.observations or not queried else ExitCode.UNREACHABLE)
