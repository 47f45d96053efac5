"""Options that many commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

InventoryPath = Annotated[
    Path,
    typer.Option(
        "--inventory",
        "-i",
        envvar="MESHCTL_INVENTORY",
        help="The inventory: a YAML file, or a directory that holds fleet.yaml.",
    ),
]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON for programs.")]
