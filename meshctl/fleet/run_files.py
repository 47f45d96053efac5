"""The files that a run changed, stored next to the journal: one directory per run, `$XDG_STATE_HOME/meshctl/runs/RUN`.

`changes` are the differences per node, with secrets masked; `before` are the files that the run replaced, which
`meshctl rollback` writes back. The latter hold the nodes' keys: they are readable by their owner only, and removed
once `MAX_BEFORE` later runs have theirs.
"""

from __future__ import annotations

import gzip
import json
import os
import shutil
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from meshctl.errors import MeshctlError

CHANGES, BEFORE = "changes", "before"
# the keys of what sites will report as replaced, by the ids of their runs
REPLY_KEYS = "reply-keys"
# runs of all fleets whose files are kept: some 100 KiB each for a fleet of 60 nodes
MAX_BEFORE = 50


def runs_directory(journal: Path) -> Path:
    """Where the files of a journal's runs are."""
    return journal.parent / "runs"


class RunFiles:
    """The files of all runs of a journal; `root` is the directory beside it."""

    def __init__(self, journal: Path) -> None:
        self.root = runs_directory(journal)

    def save(self, run_id: int, kind: str, nodes: Mapping[str, Any]) -> None:
        """Write one file of a run. Raises MeshctlError."""
        path = self._path(run_id, kind)
        part = path.with_suffix(".part")
        try:
            path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
            data = gzip.compress(json.dumps(nodes).encode(), mtime=0)
            with open(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), "wb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            part.replace(path)
            self._prune()
        except OSError as error:
            raise MeshctlError(f"cannot write {path}: {error.strerror}") from error

    def load(self, run_id: int, kind: str) -> dict[str, Any] | None:
        """Node -> its part; None if the run has no such file any more. Raises MeshctlError for a damaged one."""
        path = self._path(run_id, kind)
        try:
            nodes = json.loads(gzip.decompress(path.read_bytes()))
        except FileNotFoundError:
            return None
        except (OSError, EOFError, ValueError, zlib.error) as error:
            raise MeshctlError(f"cannot read {path}: {error}") from error
        if not isinstance(nodes, dict):
            raise MeshctlError(f"cannot read {path}: expected an object")
        return nodes

    def discard(self, run_id: int) -> None:
        """Remove what an earlier journal left under this number."""
        shutil.rmtree(self._path(run_id, CHANGES).parent, ignore_errors=True)

    def _path(self, run_id: int, kind: str) -> Path:
        return self.root / str(run_id) / f"{kind}.json.gz"

    def _prune(self) -> None:
        saved = sorted(self.root.glob(f"*/{BEFORE}.json.gz"), key=lambda path: path.stat().st_mtime_ns)
        for path in saved[:-MAX_BEFORE]:
            path.unlink(missing_ok=True)
