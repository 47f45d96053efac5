"""Names for the shell's completion, of the inventory that the command line, the environment or the directory gives.

An inventory that cannot be read completes to nothing: the shell shows what is printed here in the middle of a line.
"""

from __future__ import annotations

import os
from pathlib import Path

import typer

from meshctl.errors import MeshctlError


def complete_node(ctx: typer.Context, incomplete: str) -> list[str]:
    """The nodes whose names begin with the word."""
    # commands import this module for their arguments
    from meshctl.inventory.load import load_fleet

    try:
        fleet = load_fleet(Path(ctx.params.get("inventory") or "."), environ=os.environ)
    except MeshctlError:
        return []
    return [name for name in fleet.nodes if name.startswith(incomplete)]


def complete_nodes(ctx: typer.Context, incomplete: str) -> list[str]:
    """The same for the last of several words between commas, such as `b01,b0`, or after an exclamation mark."""
    before, comma, last = incomplete.rpartition(",")
    sign = "!" if last.startswith("!") else ""
    return [f"{before}{comma}{sign}{name}" for name in complete_node(ctx, last.removeprefix("!"))]
