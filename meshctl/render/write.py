"""Write a node's files to disk: all or none, with their modes, and secrets unreadable by others.

A folder is written next to its destination and renamed, so the destination always is exactly one rendering. A folder
that meshctl did not write is never replaced.
"""

from __future__ import annotations

import os
import shutil
import stat
import tempfile
from collections.abc import Iterable
from pathlib import Path

from meshctl.errors import InputError
from meshctl.render.rendered import MARKER_PATH, Rendered, RenderedFile


def write_node(rendered: Rendered, out: Path) -> Path:
    """Write the node's files, and no others, to `out/NODE/`; returns that folder.

    Raises InputError if the folder cannot be written, was not written by meshctl, or cannot keep a secret.
    """
    return write_folder(rendered.files, out / rendered.node, marker=MARKER_PATH)


def write_folder(files: Iterable[RenderedFile], place: Path, *, marker: str) -> Path:
    """Write the files, and no others, to `place`. Raises InputError as `write_node` does.

    An existing folder is replaced only if it contains the file `marker`, which identifies meshctl's own folders.
    """
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
        _refuse_foreign(place, marker)
        fresh = Path(tempfile.mkdtemp(prefix=f".{place.name}.", dir=place.parent))
        try:
            for file in files:
                _write(file, fresh)
            fresh.chmod(0o700)
            _swap(fresh, place)
        finally:
            shutil.rmtree(fresh, ignore_errors=True)
    except OSError as error:
        raise InputError(f"{place}: cannot be written: {error.strerror or error}") from error
    return place


def _refuse_foreign(place: Path, marker: str) -> None:
    if place.is_symlink() or (place.exists() and not place.is_dir()):
        raise InputError(f"{place}: exists and is not a folder")
    if place.is_dir() and any(place.iterdir()) and not (place / marker).is_file():
        raise InputError(
            f"{place}: expected a folder that meshctl rendered, found one without {marker}",
            hint="choose another --out, or remove the folder yourself",
        )
    others_may_write = place.parent.stat().st_mode & (stat.S_IWGRP | stat.S_IWOTH)
    is_sticky = place.parent.stat().st_mode & stat.S_ISVTX
    if others_may_write and not is_sticky:
        raise InputError(
            f"{place.parent}: writable by others, who could replace a node's files",
            hint=f"chmod go-w {place.parent}, or choose another --out",
        )


def _write(file: RenderedFile, root: Path) -> None:
    path = root / file.path
    _make_folders(path.parent, root)
    # unreadable by others from creation, regardless of the umask
    handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o600)
    with os.fdopen(handle, "wb") as stream:
        os.fchmod(stream.fileno(), file.mode)
        mode = stat.S_IMODE(os.fstat(stream.fileno()).st_mode)
        if file.secrets and mode & 0o077:
            raise InputError(
                f"{path}: expected a file system that keeps a secret (mode {file.mode:04o}), found mode {mode:04o}",
                hint="choose an --out on a file system with permissions",
            )
        stream.write(file.content)
        stream.flush()
        os.fsync(stream.fileno())


def _make_folders(folder: Path, root: Path) -> None:
    """Create the folders below `root` with their modes on the device, which the ImageBuilder copies.

    `root` itself is closed to others, and so is everything below it.
    """
    if folder == root:
        return
    _make_folders(folder.parent, root)
    folder.mkdir(exist_ok=True)
    # as in OpenWrt: dropbear's keys are for root only
    folder.chmod(0o700 if folder.name == "dropbear" else 0o755)


def _swap(fresh: Path, place: Path) -> None:
    if not place.exists():
        fresh.rename(place)
        return
    old = Path(tempfile.mkdtemp(prefix=f".{place.name}.old.", dir=place.parent))
    try:
        place.rename(old / place.name)
        fresh.rename(place)
    finally:
        if not place.exists():
            # the second rename failed: restore the old folder
            (old / place.name).rename(place)
        shutil.rmtree(old, ignore_errors=True)
