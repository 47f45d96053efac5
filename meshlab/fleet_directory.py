"""The directory of a virtual fleet: which directories `meshctl lab up` may use, and what it may replace in them.

`claim` rejects a directory with other contents or with a running fleet, and marks any other as the lab's. Then `clear`
removes the files of an earlier fleet, and `replace_inventory` replaces the earlier copy of the inventory. An earlier
copy with edits is kept beside the new one.
"""

from __future__ import annotations

import hashlib
import json
import os
import shlex
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
# digests of the inventory's copy when it was made, to detect edits
_DIGESTS = "inventory.digests.json"
# the earlier copy, until the new one has replaced it
_PREVIOUS = "before"
_FOLDERS = ("rom", "nodes", "mnt")
_FILES = ("events", "failure", "control.sock", "supervisor.pid", "log", "ground.json")


def claim(directory: Path) -> None:
    """Create `directory` if needed and mark it as the lab's.

    Raises LabError, without changing anything, when a fleet runs there or the lab did not write its contents.
    """
    if is_running(directory):
        raise LabError(
            f"a virtual fleet runs in {directory} already",
            hint=f"run `meshctl lab down --dir {shlex.quote(str(directory))}` to stop it, or choose another --dir",
        )
    try:
        if directory.exists() and any(directory.iterdir()) and not is_lab(directory):
            raise LabError(
                f"{directory}: expected an empty directory or one made by `meshctl lab up`, found other files",
                hint="choose another --dir",
            )
        directory.mkdir(parents=True, exist_ok=True)
        (directory / MARK).write_text(_MARK_TEXT, encoding="utf-8")
    except OSError as error:
        raise LabError(f"cannot use {directory}: {error.strerror or error}", hint="choose another --dir") from None


def clear(directory: Path) -> None:
    """Remove the files of an earlier fleet from a claimed directory. Raises LabError when one is not of its kind."""
    leftovers = [directory / name for name in (*_FOLDERS, *_FILES)]
    for path in leftovers:
        expected = "a directory" if path.name in _FOLDERS else "a file"
        is_there = path.exists() and not path.is_symlink()
        if is_there and path.is_dir() != (path.name in _FOLDERS):
            raise LabError(
                f"{path}: expected {expected} of an earlier fleet, found something else", hint="move it elsewhere"
            )
    try:
        for path in leftovers:
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path)
            else:
                path.unlink(missing_ok=True)
    except OSError as error:
        raise LabError(f"cannot remove {error.filename}: {error.strerror}") from error


def replace_inventory(folder: Path, directory: Path, *, without: Iterable[str] = ()) -> Path | None:
    """Copy the inventory's `folder` to `inventory` in a claimed directory.

    Returns the path of the earlier copy if it had edits, else None. `folder` may be the earlier copy itself. Top-level
    names in `without` are not copied. Raises InputError when the copy fails; the earlier copy is then unchanged.
    """
    target = directory / INVENTORY
    if folder.resolve() == directory.resolve():
        raise InputError(f"{folder}: expected an inventory outside --dir", hint="choose another --dir")
    top, own = str(folder), directory.resolve()

    def left_out(place: str, names: list[str]) -> set[str]:
        # the lab's own directory may be inside the inventory's
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
        raise InputError(f"cannot copy {folder} to {target}: {error}") from error
    finally:
        shutil.rmtree(staging, ignore_errors=True)
    return kept


def _keep_edited_copy(target: Path, staging: Path, *, is_source: bool) -> Path | None:
    """Move the earlier copy into `staging`, or to a name of its own if it has edits and is not itself the source."""
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
    """Record the copy's digests, to detect edits later."""
    text = json.dumps(digests(directory / INVENTORY), indent=1)
    (directory / _DIGESTS).write_text(text, encoding="utf-8")


def _recorded_digests(directory: Path) -> dict[str, str] | None:
    try:
        found: dict[str, str] = json.loads((directory / _DIGESTS).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return found


def digests(folder: Path) -> dict[str, str]:
    """SHA-256 of each file by its path in the folder, without known_hosts files: those end with the fleet."""
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
