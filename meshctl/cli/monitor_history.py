"""Where the history of a fleet is: the file that `meshctl monitor` writes and `meshctl alarms` reads."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from meshctl.fleet.journal import default_path

HistoryFile = Annotated[
    Path | None,
    typer.Option("--store", metavar="FILE", help="History file; default: that of the inventory's fleet."),
]


def history_path(fleet: str, lab: Path | None) -> Path:
    """`$XDG_STATE_HOME/meshctl/monitor/FLEET.sqlite`; of a virtual fleet `monitor.sqlite` in its own directory."""
    if lab is not None:
        return lab / "monitor.sqlite"
    return default_path(os.environ).parent / "monitor" / f"{fleet}.sqlite"
