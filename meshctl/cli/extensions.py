"""Extensions of meshctl from other packages, found by entry points of the group `meshctl.extensions`.

`lab` is a Typer app, the commands of `meshctl lab`; `lab-fleet` attaches to a running virtual fleet (`--lab`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, cast

from meshctl.errors import InputError

if TYPE_CHECKING:
    from meshctl.device.connection import Endpoint

_GROUP = "meshctl.extensions"


class LabFleet(Protocol):
    """The part of a running virtual fleet that the commands use."""

    @property
    def directory(self) -> Path: ...

    @property
    def node_names(self) -> tuple[str, ...]: ...

    def endpoint(self, address: str) -> Endpoint:
        """The local endpoint of the node with `address`."""

    @property
    def positions(self) -> Mapping[str, tuple[float, float]]:
        """Where its nodes are, in meters, if it has positions."""

    def bench_endpoint(self, name: str) -> Endpoint:
        """The local endpoint of the factory address of node `name`."""


def attach_lab(directory: Path) -> LabFleet:
    """The virtual fleet that runs in `directory`. Raises MeshctlError if there is none."""
    attach = cast("Callable[[Path], LabFleet]", load("lab-fleet"))
    return attach(directory)


def load(name: str) -> Any:
    """The object of the extension `name`. Raises InputError if it is not installed."""
    # takes a tenth of the start-up, and few commands use an extension
    from importlib.metadata import entry_points

    for entry in entry_points(group=_GROUP, name=name):
        return entry.load()
    raise InputError(f"meshctl extension {name!r} is not installed", hint="install meshctl from its wheel")
