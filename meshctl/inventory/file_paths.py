"""Paths that an inventory names -> paths on this machine."""

from __future__ import annotations

import os.path
from pathlib import Path

from meshctl.model import Fleet


def file_path(fleet: Fleet, written: str, base: str = "") -> Path:
    """The path that the inventory writes as `written`: `~` is a home directory, a relative path starts at `base`, by
    default the inventory's directory."""
    # Path.expanduser raises for an unknown user
    return Path(base or fleet.base or ".", os.path.expanduser(written))


def known_hosts_path(fleet: Fleet) -> Path:
    """The file of pinned host keys."""
    return file_path(fleet, fleet.operators.known_hosts)
