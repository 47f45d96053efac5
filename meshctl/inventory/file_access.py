"""Which files an inventory may name to be read as its own: those of its tree, and no pipe or device.

An inventory may be untrusted, such as a pull request that CI lints. Its includes and templates are shown in
findings and renderings, so they must not reach /etc/shadow, a token beside the checkout, or a pipe that never ends.
The tree is the git work tree that holds the inventory, else the directory of its first file. `MESHCTL_INCLUDE_PATH`
(directories joined by `:`) adds others.
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
    """`roots` are real paths of directories; the first one is the inventory's tree."""

    roots: tuple[str, ...]

    @classmethod
    def of(cls, folder: Path, environ: Mapping[str, str]) -> Boundary:
        """For an inventory whose first file lies in `folder`."""
        more = [path for path in environ.get(VARIABLE, "").split(":") if path]
        return cls((_tree(folder), *(os.path.realpath(os.path.expanduser(path)) for path in more)))

    def refusal(self, path: Path) -> str:
        """Why `path`, with symbolic links followed, may not be read as part of the inventory; empty when it may."""
        real = os.path.realpath(path)
        inside = [root for root in self.roots if real == root or real.startswith(root.rstrip("/") + "/")]
        if not inside:
            return f"outside the inventory's tree {self.roots[0]}"
        if ".git" in os.path.relpath(real, inside[0]).split("/"):
            return "inside git's own directory"
        return special_file(path)


def special_file(path: Path) -> str:
    """What a file is that never ends or has no content of its own: a pipe, a device, a socket; empty for the rest."""
    try:
        mode = path.stat().st_mode
    except (OSError, ValueError):
        # reading it gives the reason
        return ""
    return "" if stat.S_ISREG(mode) or stat.S_ISDIR(mode) else "not a regular file, but a pipe, a socket or a device"


def _tree(folder: Path) -> str:
    real = Path(os.path.realpath(folder))
    for parent in (real, *real.parents):
        if (parent / ".git").exists():
            return str(parent)
    return str(real)
