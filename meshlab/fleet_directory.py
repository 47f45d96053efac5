"""The directory of a virtual fleet: which directories `meshctl lab up` may use, and what it may replace in them.

`claim` refuses a directory that has other contents or in which a fleet runs, and marks the rest as the lab's. Only then
`clear` removes what an earlier fleet left there, `replace_inventory` the earlier copy of the inventory. A copy that was
edited since is kept beside the new one.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import tempfile
import time
from collections.abc import Iterable
from pathlib import Path

from meshctl.errors import InputError
from meshctl.fleet.lab_directory import INVENTORY, MARK, is_lab
from meshlab.client import is_running
from meshlab.errors import LabError

_MARK_TEXT = "`meshctl lab up` made this directory, and replaces the fleet and the inventory in it.\n"
# the digests of the inventory's copy as it was made, to recognize edits
_DIGESTS = "inventory.digests.json"
# the earlier copy, until the new one stands in its place
_PREVIOUS = "before"
_FOLDERS = ("rom", "nodes", "mnt")
_FILES = ("bell", "failure", "control.sock", "supervisor.pid", "log", "ground.json")


def claim(directory: Path) -> None:
    """Make `directory` the lab's, and mark it. Changes nothing when it refuses.

    Raises LabError when a fleet runs there or the directory has contents that no lab wrote.
    """
    if is_running(directory):
        raise LabError(
            f"a virtual fleet runs in {directory} already",
            hint="`meshctl lab down` ends it; --dir DIR starts another one elsewhere",
        )
    try:
        if directory.exists() and any(directory.iterdir()) and not is_lab(directory):
            raise LabError(
                f"{directory}: expected a directory that `meshctl lab up` made, or an empty one; found other files",
                hint="choose another --dir",
            )
        directory.mkdir(parents=True, exist_ok=True)
        (directory / MARK).write_text(_MARK_TEXT, encoding="utf-8")
    except OSError as error:
        raise LabError(f"{directory}: cannot be used: {error.strerror or error}", hint="choose another --dir") from None


def clear(directory: Path) -> None:
    """Remove what an earlier fleet left in a claimed directory. Raises LabError for what no fleet leaves there."""
    leftovers = [directory / name for name in (*_FOLDERS, *_FILES)]
    for path in leftovers:
        expected = "a directory" if path.name in _FOLDERS else "a file"
        is_there = path.exists() and not path.is_symlink()
        if is_there and path.is_dir() != (path.name in _FOLDERS):
            raise LabError(
                f"{path}: expected {expected} that an earlier fleet left, found something else", hint="move it away"
            )
    try:
        for path in leftovers:
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path)
            else:
                path.unlink(missing_ok=True)
    except OSError as error:
        raise LabError(f"{error.filename}: cannot be removed: {error.strerror}") from error


def replace_inventory(folder: Path, directory: Path, *, without: Iterable[str] = ()) -> Path | None:
    """Copy the inventory's `folder` to `inventory` in a claimed directory; returns where edits of the earlier copy are
    kept, None when there were none.

    `folder` may be the earlier copy itself. Names in `without` are left out at its top. Raises InputError when it
    cannot be copied; the earlier copy is then as it was.
    """
    target = directory / INVENTORY
    if folder.resolve() == directory.resolve():
        raise InputError(f"{folder}: expected an inventory outside --dir, found one in it", hint="choose another --dir")
    top, own = str(folder), directory.resolve()

    def left_out(place: str, names: list[str]) -> set[str]:
        # the lab's own directory may lie inside the inventory's
        inside = {name for name in names if Path(place, name).resolve() == own}
        return inside | (set(without) if place == top else set())

    staging = Path(tempfile.mkdtemp(prefix=f".{INVENTORY}.", dir=directory))
    try:
        shutil.copytree(folder, staging / INVENTORY, ignore=left_out)
        kept = _keep_edited_copy(target, staging, is_source=folder.resolve() == target.resolve())
        (staging / INVENTORY).rename(target)
    except (OSError, shutil.Error) as error:
        if not target.exists() and (staging / _PREVIOUS).exists():
            (staging / _PREVIOUS).rename(target)
        raise InputError(f"{folder} cannot be copied to {target}: {error}") from error
    finally:
        shutil.rmtree(staging, ignore_errors=True)
    return kept


def _keep_edited_copy(target: Path, staging: Path, *, is_source: bool) -> Path | None:
    """Take away the earlier copy: into `bin_`, or when it was edited and is not copied again, to a name of its own."""
    if not target.exists() and not target.is_symlink():
        return None
    if is_source or digests(target) == _recorded_digests(target.parent):
        target.rename(staging / _PREVIOUS)
        return None
    stem = f"{target.name}.kept-{time.strftime('%Y%m%dT%H%M%S')}"
    free = (target.with_name(stem + ending) for ending in ("", *(f"-{number}" for number in range(2, 1000))))
    kept = next(path for path in free if not path.exists())
    target.rename(kept)
    return kept


def record_digests(directory: Path) -> None:
    """Remember how the copy is now, to recognize edits later."""
    text = json.dumps(digests(directory / INVENTORY), indent=1)
    (directory / _DIGESTS).write_text(text, encoding="utf-8")


def _recorded_digests(directory: Path) -> dict[str, str] | None:
    try:
        found: dict[str, str] = json.loads((directory / _DIGESTS).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return found


def digests(folder: Path) -> dict[str, str]:
    """By path in the folder the SHA-256 of each file, but of host keys: a fleet that is gone has no use for those."""
    found = {}
    for top, folders, names in os.walk(folder):
        folders.sort()
        for name in sorted(names):
            path = Path(top, name)
            if name.lstrip(".").startswith("known_hosts"):
                continue
            content = path.read_bytes() if path.is_file() else b""
            found[path.relative_to(folder).as_posix()] = hashlib.sha256(content).hexdigest()
    return found
