"""File access of lint: cached facts about the files that an inventory names."""

from __future__ import annotations

import os
import shutil
import stat
import subprocess
from itertools import islice
from pathlib import Path

from meshctl import firmware
from meshctl.diagnostics import Diagnostic
from meshctl.model import HardwareProfile

# 10,000 pinned keys take about 4 MB
_MAX_TEXT_BYTES = 16 * 1024 * 1024
# a home directory, or a folder of logs, is not one of an inventory
_MAX_ENTRIES = 1000
# git answers immediately, or hangs on an unavailable network file system
_GIT_TIMEOUT_S = 10


class DiskFiles:
    """`meshctl.lint.context.Files` on the real file system, cached.

    An impossible name (with a NUL, for which Python raises ValueError) counts as a missing file.
    """

    def __init__(self) -> None:
        self._firmware: dict[HardwareProfile, tuple[Diagnostic, ...]] = {}
        self._versions: dict[HardwareProfile, str] = {}
        self._tracked: dict[Path, bool] = {}

    def size_bytes(self, path: Path) -> int | None:
        found = _status(path)
        return None if found is None else found.st_size

    def mode(self, path: Path) -> int | None:
        found = _status(path)
        return None if found is None else stat.S_IMODE(found.st_mode)

    def is_special(self, path: Path) -> bool:
        try:
            return not stat.S_ISREG(path.stat().st_mode)
        except (OSError, ValueError):
            return False

    def text(self, path: Path) -> str | None:
        size = self.size_bytes(path)
        if size is None or size > _MAX_TEXT_BYTES:
            return None
        try:
            return path.read_text(encoding="utf-8", errors="replace")
        except OSError:
            return None

    def inside(self, folder: Path) -> tuple[Path, ...]:
        try:
            with os.scandir(folder) as entries:
                found = [entry.name for entry in islice(entries, _MAX_ENTRIES + 1) if entry.is_file()]
        except (OSError, ValueError):
            return ()
        return tuple(folder / name for name in sorted(found)) if len(found) <= _MAX_ENTRIES else ()

    def in_repository(self, path: Path) -> bool:
        if path not in self._tracked:
            self._tracked[path] = _would_be_committed(path)
        return self._tracked[path]

    def firmware(self, profile: HardwareProfile) -> tuple[Diagnostic, ...]:
        if profile not in self._firmware:
            image = firmware.image_path(profile)
            self._firmware[profile] = () if image is None else firmware.check(image, profile)
        return self._firmware[profile]

    def image_version(self, profile: HardwareProfile) -> str:
        if profile not in self._versions:
            image = firmware.image_path(profile)
            self._versions[profile] = "" if image is None else firmware.image_version(image)
        return self._versions[profile]


def _status(path: Path) -> os.stat_result | None:
    """The status of a regular file, None for anything else."""
    try:
        found = path.stat()
    except (OSError, ValueError):
        return None
    return found if stat.S_ISREG(found.st_mode) else None


def _would_be_committed(path: Path) -> bool:
    # resolved: `..` and symbolic links lead into and out of work trees
    try:
        absolute = path.resolve()
    except OSError:
        return False
    if not any((parent / ".git").exists() for parent in absolute.parents):
        return False
    git = shutil.which("git")
    if git is None:
        return True
    try:
        ignored = subprocess.run(
            [git, "-C", str(absolute.parent), "check-ignore", "-q", "--", str(absolute)],
            check=False,
            capture_output=True,
            timeout=_GIT_TIMEOUT_S,
        )
    except (OSError, subprocess.TimeoutExpired):
        return True
    # 0: ignored, 1: not ignored, 128: unknown
    return ignored.returncode != 0
