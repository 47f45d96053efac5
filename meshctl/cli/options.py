"""Options that many commands share, and the width that all of them write to."""

from __future__ import annotations

import os
import shutil
import sys
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


def line_width(*, wide: bool = False) -> int | None:
    """The terminal's, or COLUMNS; None where nobody wants lines broken."""
    if wide or not (sys.stdout.isatty() or os.environ.get("COLUMNS", "").isdecimal()):
        return None
    return shutil.get_terminal_size().columns
