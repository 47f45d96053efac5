"""What can go wrong with a virtual fleet; never with a node's own behaviour."""

from __future__ import annotations

from meshctl.errors import MeshctlError


class LabError(MeshctlError):
    """The virtual fleet cannot start, is not there, or was asked for something it has not."""
