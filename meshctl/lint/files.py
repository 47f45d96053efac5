"""The one place where lint touches the disk: facts about the files an inventory names, each found out once."""

from __future__ import annotations

import os
import shutil
import stat
import subprocess
from pathlib import Path

from meshctl import firmware
from meshctl.diagnostics import Diagnostic
from meshctl.model import HardwareProfile

# ten thousand pinned keys take some 4 MB
_MAX_TEXT_BYTES = 16 * 1024 * 1024
# git answers at once, or hangs on a network file system that is gone
_GIT_TIMEOUT_S = 10


class DiskFiles:
    """`meshctl.lint.context.Files` on the real file system, with a memory.

    A name that no file can have (one with a NUL, a ValueError to Python) is a file that is not there.
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
    # where the bytes are: `..` and symbolic links lead out of a work tree, and into one
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
    # 0: ignored, 1: not, 128: git cannot tell
    return ignored.returncode != 0
