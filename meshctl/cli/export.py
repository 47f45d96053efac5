"""`meshctl inventory export`: the fleet for ssh, Ansible, spreadsheets, NetJSON and the label printer."""

from __future__ import annotations

import json
import os
import sys
from dataclasses import replace
from enum import Enum
from pathlib import Path
from typing import Annotated

import typer

from meshctl.cli.context import InventoryPath, Lab, Limit, Nodes, lab_at, locate_in, selected_nodes, trust_of
from meshctl.cli.extensions import LabFleet
from meshctl.cli.output import echo, echo_bytes, write_file
from meshctl.errors import InputError
from meshctl.interchange.label_sheet import SHEETS, draw, is_printable, labels
from meshctl.interchange.netjson import configurations, network_graph
from meshctl.inventory import csv_table
from meshctl.inventory.file_paths import file_path, known_hosts_path
from meshctl.inventory.load import load_fleet
from meshctl.model import Fleet, Node
from meshctl.render.compare import placeholder_secret
from meshctl.render.host_lists import ansible_inventory, host_entries, lab_host_entries, ssh_config
from meshctl.wording import join_limited


class ExportFormat(Enum):
    SSH_CONFIG = "ssh-config"
    ANSIBLE = "ansible"
    CSV = "csv"
    NETJSON = "netjson"
    NETJSON_CONFIG = "netjson-config"
    LABELS = "labels"


_PAPER = "L7160"
_HOST_LISTS = (ExportFormat.SSH_CONFIG, ExportFormat.ANSIBLE)
_SELECTABLE = (ExportFormat.CSV, ExportFormat.NETJSON_CONFIG, ExportFormat.LABELS)


def export(
    nodes: Nodes = None,
    limit: Limit = None,
    inventory: InventoryPath = Path(),
    format: Annotated[ExportFormat, typer.Option("--format", "-f", help="What to write.")] = ExportFormat.SSH_CONFIG,
    out: Annotated[Path | None, typer.Option("--out", help="Write to this file instead of standard output.")] = None,
    sheet: Annotated[
        str,
        typer.Option(
            "--sheet",
            help=f"Label paper: 5160 (Letter, 30 labels) or L7160 (A4, 21 labels); default {_PAPER}.",
            show_default=False,
        ),
    ] = "",
    skip: Annotated[int, typer.Option("--skip", help="Labels of the first sheet that are already used.")] = 0,
    outlines: Annotated[
        bool, typer.Option("--outlines", help="Draw the labels' edges, to cut plain paper or to check the position.")
    ] = False,
    lab: Lab = None,
) -> None:
    """Export the fleet for other tools: OpenSSH, Ansible, spreadsheets, NetJSON, label paper.

    ssh-config and ansible have all managed nodes and robot computers, csv is the table that `meshctl inventory import`
    reads, netjson the planned topology, netjson-config the nodes' configurations, labels a PDF with name, MAC and host
    key fingerprint for the lids.

    With --lab, ssh-config and ansible name the virtual fleet's forwarded ports, and no computers: a lab has none.

    NetJSON is draft-capoano-kaplan-netjson-00; mesh keys are never in it. Labels need the extra `labels`.

    Example: meshctl inventory export --out fleet.ssh_config && ssh -F fleet.ssh_config b03

    Example: meshctl inventory export role:beacon --format labels --sheet 5160 --out lids.pdf
    """
    fleet = load_fleet(inventory, environ=os.environ)
    if (nodes or limit) and format not in _SELECTABLE:
        kinds = ", ".join(each.value for each in _SELECTABLE)
        raise InputError(f"--format {format.value} exports the whole fleet", hint=f"select nodes for {kinds}")
    if format is ExportFormat.LABELS:
        _write_labels(fleet, selected_nodes(fleet, nodes, limit), out, sheet or _PAPER, skip=skip, outlines=outlines)
        return
    for option, given in {"--sheet": sheet, "--skip": skip, "--outlines": outlines}.items():
        if given:
            raise InputError(f"{option}: --format {format.value} prints no labels", hint="add `--format labels`")
    if format in _HOST_LISTS:
        text = _hosts(fleet, format, lab_at(lab, inventory)[0])
    else:
        text = _text(fleet, format, nodes, limit)
    if out is None:
        echo(text, nl=False)
    else:
        write_file(out, text, inventory=fleet.files)


def _text(fleet: Fleet, format: ExportFormat, nodes: list[str] | None, limit: list[str] | None) -> str:
    if format is ExportFormat.CSV:
        chosen = selected_nodes(fleet, nodes, limit) if nodes or limit else fleet.nodes.values()
        return csv_table.write(chosen)
    if format is ExportFormat.NETJSON:
        return json.dumps(network_graph(fleet), indent=2) + "\n"
    # a key is needed to resolve an encrypted mesh, and is not exported
    found = configurations(fleet, selected_nodes(fleet, nodes, limit), placeholder_secret)
    return json.dumps(found, indent=2) + "\n"


def _write_labels(
    fleet: Fleet, chosen: tuple[Node, ...], out: Path | None, paper: str, *, skip: int, outlines: bool
) -> None:
    if paper not in SHEETS:
        raise InputError(f"--sheet {paper}: no such label paper", hint=f"expected one of {', '.join(SHEETS)}")
    if out is None and sys.stdout.isatty():
        raise InputError("not writing a PDF to a terminal", hint="give --out labels.pdf")
    trust = trust_of(fleet)
    found = labels(chosen, lambda name: tuple(key.fingerprint for key in trust.pinned(name)))
    content = draw(found, SHEETS[paper], skip=skip, outlines=outlines)
    if out is None:
        echo_bytes(content)
    else:
        write_file(out, content, inventory=fleet.files)
    unprintable = [each.name for each in found if not is_printable(each)]
    if unprintable:
        hint = "the sheet's fonts have Western European characters only; the code has name, MAC and key"
        echo(f"printed with '?' in label or serial number: {join_limited(unprintable)}; {hint}", err=True)
    unpinned = [each.name for each in found if not each.fingerprints]
    if unpinned:
        echo(f"without a host key: {join_limited(unpinned)}; pin them with `meshctl trust`, then print again", err=True)


def _hosts(fleet: Fleet, format: ExportFormat, virtual: LabFleet | None) -> str:
    if virtual is None:
        entries = host_entries(fleet, fleet.managed())
    else:
        locate = locate_in(virtual)
        entries = lab_host_entries(fleet, fleet.managed(), lambda node: locate(node, node.address.ip))
    write = ssh_config if format is ExportFormat.SSH_CONFIG else ansible_inventory
    # ssh and Ansible may be started in another directory
    placed = replace(fleet, base=str(Path(fleet.base).resolve()))
    return write(entries, known_hosts_path(placed), lambda name: file_path(placed, name))
