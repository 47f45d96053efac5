"""What other distributions or packages add to meshctl, found by entry points of the group `meshctl.extensions`.

`lab` is a Typer app, the commands of `meshctl lab`; `lab-fleet` attaches to a running virtual fleet (`--lab`).
"""

from __future__ import annotations

from collections.abc import Callable
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Protocol, cast

from meshctl.device.connection import Endpoint
from meshctl.errors import InputError

_GROUP = "meshctl.extensions"


class LabFleet(Protocol):
    """A running virtual fleet, as far as the commands use it."""

    @property
    def directory(self) -> Path: ...

    @property
    def node_names(self) -> tuple[str, ...]: ...

    def endpoint(self, address: str) -> Endpoint:
        """Where on this machine the node with `address` is reached."""

    def bench_endpoint(self, name: str) -> Endpoint:
        """Where the node called `name` is reached at its factory address."""


def attach_lab(directory: Path) -> LabFleet:
    """The virtual fleet that runs in `directory`. Raises MeshctlError when none does."""
    attach = cast("Callable[[Path], LabFleet]", load("lab-fleet"))
    return attach(directory)


def load(name: str) -> Any:
    """The object that the extension `name` declares. Raises InputError when none is installed."""
    for entry in entry_points(group=_GROUP, name=name):
        return entry.load()
    raise InputError(f"the extension {name!r} of meshctl is not installed", hint="install meshctl from its wheel")
