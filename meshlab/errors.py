"""Errors of the lab itself, never of a node's software."""

from __future__ import annotations

from meshctl.errors import MeshctlError


class LabError(MeshctlError):
    """The virtual fleet cannot start, is not running, or does not have what was requested."""
