"""The mark of a virtual fleet's directory, by which practice and field never share a journal."""

from __future__ import annotations

import json
from pathlib import Path

MARK = ".meshctl-lab"
INVENTORY = "inventory"
KEY_COMMENT = "lab-operator"


def is_lab(directory: Path) -> bool:
    """Marked, or made by a meshctl that did not mark: then it has a fleet's description and the lab's login key."""
    if (directory / MARK).is_file():
        return True
    try:
        described = json.loads((directory / "spec.json").read_text(encoding="utf-8"))
        public = (directory / "keys" / "operator.pub").read_text(encoding="utf-8")
    except (OSError, ValueError):
        return False
    is_fleet = isinstance(described, dict) and {"nodes", "links"} <= described.keys()
    return is_fleet and public.rstrip().endswith(KEY_COMMENT)


def lab_of(inventory: str) -> str:
    """The directory of the lab whose copy `inventory` (a file or a directory) is; empty for a real one."""
    path = Path(inventory)
    for folder in (path, path.parent):
        if folder.name == INVENTORY and is_lab(folder.parent):
            return str(folder.parent.resolve())
    return ""
