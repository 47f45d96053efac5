"""Options that many commands share."""

from __future__ import annotations

import os
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
LabDirectory = Annotated[
    Path | None,
    typer.Option("--dir", envvar="MESHCTL_LAB", help="Where the fleet lives; default: $XDG_STATE_HOME/meshctl/lab."),
]


def lab_directory(given: Path | None) -> Path:
    """Where the fleet lives when `LabDirectory` gives no place."""
    if given is not None:
        return given
    home = os.environ.get("XDG_STATE_HOME") or Path("~/.local/state").expanduser()
    return Path(home) / "meshctl" / "lab"
