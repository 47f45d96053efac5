"""Shared state of a running fleet: its nodes, and the calls that act on a node.

The supervisor owns both. Link state, port forwarding, fault injection and the control socket get them as arguments, so
that none of these needs the supervisor itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol

from meshctl.errors import InputError
from meshlab.container import Container
from meshlab.spec import FleetSpec
from meshlab.state import NodeState


class FleetState:
    """The nodes by name, in the order of the spec. `deny_setgroups`: the fleet runs in an unprivileged namespace."""

    def __init__(self, spec: FleetSpec, directory: Path, *, deny_setgroups: bool = False) -> None:
        self.spec = spec
        self.directory = directory
        self.deny_setgroups = deny_setgroups
        self.nodes: dict[str, NodeState] = {}

    def node(self, name: str) -> NodeState:
        """Raises InputError for a name the fleet does not have."""
        try:
            return self.nodes[name]
        except KeyError:
            raise InputError(f"no node named {name} in this fleet", hint=f"nodes: {', '.join(self.nodes)}") from None

    def container(self, state: NodeState) -> Container:
        spec = state.spec
        return Container(spec.name, self.directory, spec.overlay_kib, spec.memory_kib, self.deny_setgroups)


class NodeControl(Protocol):
    """Acts on the nodes; the supervisor implements it."""

    def power_on(self, name: str) -> None: ...

    def power_off(self, name: str, *, back: bool) -> None: ...

    async def request(
        self, request: dict[str, Any], descriptors: Sequence[int] = ()
    ) -> tuple[dict[str, Any], list[int]]:
        """Send a request to the node runner and return its event with the descriptors beside it."""
        ...

    def stop(self) -> None:
        """End the fleet."""
        ...
