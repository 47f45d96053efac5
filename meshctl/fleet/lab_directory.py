"""Recognize the directory of a virtual fleet, so that its journal is separate from the real fleet's."""

from __future__ import annotations

import json
from pathlib import Path

MARK = ".meshctl-lab"
INVENTORY = "inventory"
KEY_COMMENT = "lab-operator"


def is_lab(directory: Path) -> bool:
    """Whether it is marked as a lab, or has the files of one from before the mark: a fleet spec and the login key."""
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
    """The directory of the lab that `inventory` (a file or a directory) belongs to; empty for a real one."""
    path = Path(inventory)
    for folder in (path, path.parent):
        if folder.name == INVENTORY and is_lab(folder.parent):
            return str(folder.parent.resolve())
    return ""
