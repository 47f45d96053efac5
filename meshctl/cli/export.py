"""`meshctl inventory export`: the fleet for ssh, Ansible and spreadsheets."""

from __future__ import annotations

import os
from dataclasses import replace
from enum import Enum
from pathlib import Path
from typing import Annotated

import typer

from meshctl.cli.context import InventoryPath
from meshctl.cli.output import echo, write_file
from meshctl.inventory import csv_table
from meshctl.inventory.file_paths import file_path, known_hosts_path
from meshctl.inventory.load import load_fleet
from meshctl.model import Fleet
from meshctl.render.host_lists import ansible_inventory, host_entries, ssh_config


class ExportFormat(Enum):
    SSH_CONFIG = "ssh-config"
    ANSIBLE = "ansible"
    CSV = "csv"


def export(
    inventory: InventoryPath = Path(),
    format: Annotated[ExportFormat, typer.Option("--format", "-f", help="What to write.")] = ExportFormat.SSH_CONFIG,
    out: Annotated[Path | None, typer.Option("--out", help="Write to this file instead of standard output.")] = None,
) -> None:
    """Export managed nodes and robot computers as an OpenSSH configuration or an Ansible inventory, or all nodes as the
    CSV table that `meshctl inventory import` reads.

    Example: meshctl inventory export --out fleet.ssh_config && ssh -F fleet.ssh_config b03
    """
    fleet = load_fleet(inventory, environ=os.environ)
    text = csv_table.write(fleet.nodes.values()) if format is ExportFormat.CSV else _hosts(fleet, format)
    if out is None:
        echo(text, nl=False)
    else:
        write_file(out, text)


def _hosts(fleet: Fleet, format: ExportFormat) -> str:
    entries = host_entries(fleet, fleet.managed())
    write = ssh_config if format is ExportFormat.SSH_CONFIG else ansible_inventory
    # ssh and Ansible may be started in another directory
    placed = replace(fleet, base=str(Path(fleet.base).resolve()))
    return write(entries, known_hosts_path(placed), lambda name: file_path(placed, name))
