"""Paths that an inventory names -> paths on this machine."""

from __future__ import annotations

from pathlib import Path

from meshctl.file_access import located
from meshctl.inventory.tree import MappingNode, descend
from meshctl.model import Fleet


def file_path(fleet: Fleet, written: str, base: str = "") -> Path:
    """The path that the inventory writes as `written`: `~` is a home directory, a relative path starts at `base`, by
    default the inventory's directory."""
    return located(base or fleet.base, written)


def from_inventory(written: str, base: str, inventory: str) -> str:
    """The path that a file in the directory `base` writes, relative to the inventory's directory instead."""
    if base == inventory or written.startswith(("/", "~")):
        return written
    try:
        # not os.path.relpath: the directory above a symbolic link is another one
        return str(Path(base).relative_to(inventory) / written)
    except ValueError:
        return str(Path(base).absolute() / written)


def known_hosts_path(fleet: Fleet) -> Path:
    """The file of pinned host keys."""
    return file_path(fleet, fleet.operators.known_hosts)


def base_of(root: MappingNode, *path: str | int) -> str:
    """The directory of the file that sets `path`; of the first file if none does."""
    tree = descend(root, path)
    return str(Path((root if tree is None else tree).file).parent)


def path_of(root: MappingNode, written: str, *path: str | int) -> str:
    """The path that the file with `path` writes, relative to the inventory's directory."""
    return from_inventory(written, base_of(root, *path), base_of(root))


def paths_of(root: MappingNode, written: tuple[str, ...], *path: str) -> tuple[str, ...]:
    return tuple(path_of(root, text, *path, number) for number, text in enumerate(written))
