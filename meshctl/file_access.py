"""Files that an inventory may include: those of its tree, and no pipes or devices.

An inventory may be untrusted, such as a pull request that CI lints. Findings and renderings show its files, includes
and templates, so symbolic links must not reach /etc/shadow, a token next to the checkout, or an endless pipe. The tree
is the git work tree of the inventory, else the directory of its first file. `MESHCTL_INCLUDE_PATH` (directories
separated by `:`) adds others.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

VARIABLE = "MESHCTL_INCLUDE_PATH"
HINT = f"move it there, or allow its directory: export {VARIABLE}=DIR"


@dataclass(frozen=True, slots=True)
class Boundary:
    """`roots` are resolved directories; the first one is the inventory's tree."""

    roots: tuple[str, ...]

    @classmethod
    def of(cls, folder: Path, environ: Mapping[str, str]) -> Boundary:
        """The boundary of an inventory whose first file is in `folder`."""
        more = [path for path in environ.get(VARIABLE, "").split(":") if path]
        return cls((_tree(folder), *(os.path.realpath(os.path.expanduser(path)) for path in more)))

    @property
    def is_work_tree(self) -> bool:
        """Whether the inventory is in a checkout, which may have been written by others."""
        return (Path(self.roots[0]) / ".git").exists()

    def refusal(self, path: Path) -> str:
        """Why `path`, with symbolic links resolved, must not be read as part of the inventory; empty if it may."""
        try:
            real = os.path.realpath(path)
        except ValueError:
            # an impossible name: reading reports it
            return ""
        inside = [root for root in self.roots if real == root or real.startswith(root.rstrip("/") + "/")]
        if not inside:
            return f"outside the inventory's tree {self.roots[0]}"
        if ".git" in os.path.relpath(real, inside[0]).split("/"):
            return "inside git's own directory"
        return special_file(path)


def located(base: str | Path, written: str) -> Path:
    """The path that a file in the directory `base` writes as `written`: `~` is a home directory."""
    # Path.expanduser raises for an unknown user
    return Path(base or ".", os.path.expanduser(written))


def special_file(path: Path) -> str:
    """A description of a pipe, device or socket, which may never end; empty for regular files and directories."""
    try:
        mode = path.stat().st_mode
    except (OSError, ValueError):
        # reading reports the reason
        return ""
    return "" if stat.S_ISREG(mode) or stat.S_ISDIR(mode) else "not a regular file (a pipe, socket or device)"


def _tree(folder: Path) -> str:
    real = Path(os.path.realpath(folder))
    for parent in (real, *real.parents):
        if (parent / ".git").exists():
            return str(parent)
    return str(real)
