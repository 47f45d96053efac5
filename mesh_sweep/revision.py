"""The revision of the code that computes a result: its version, and a hash of its sources.

A hash rather than git's commit: it is the same for a checkout and an installed wheel, and another one for a changed
working tree.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path

from mesh_sweep.errors import SweepError


@lru_cache(maxsize=8)
def source_revision(root: Path, parts: Iterable[str]) -> str:
    """`VERSION-HASH` of the Python files below these directories or files of the package in `root`."""
    stated = re.search(r'^__version__ = "([^"]+)"', (root / "__init__.py").read_text("utf-8"), re.MULTILINE)
    digest = hashlib.sha256()
    for part in parts:
        place = root / part
        for file in sorted(place.rglob("*.py")) if place.is_dir() else [place]:
            digest.update(f"{file.relative_to(root).as_posix()}\0".encode())
            digest.update(hashlib.sha256(file.read_bytes()).digest())
    return f"{stated[1] if stated else 0}-{digest.hexdigest()[:12]}"


def check_worker(expected: str, own: str) -> None:
    """Raises SweepError on a worker whose code is not that of the machine that collects the results."""
    if own != expected:
        raise SweepError(
            f"expected workers with revision {expected}, found one with {own}: install the same version on each worker "
            "and restart it"
        )
