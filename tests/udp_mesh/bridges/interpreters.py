"""Older Pythons of the machine a test runs on."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path


def older_interpreters(*minors: int) -> list[str]:
    """Each Python 3.8 or later, older than this one (or of these minor versions), on the path or among pyenv's."""
    named = [f"python3.{minor}" for minor in minors or range(8, sys.version_info.minor)]
    found = [path for path in map(shutil.which, named) if path]
    pyenv = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"
    found += [str(path) for name in named for path in sorted(pyenv.glob(f"{name[6:]}.*/bin/python"))]
    # A pyenv shim may stand for a version that is not chosen: then it does not start.
    return [
        path for path in found if subprocess.run([path, "-c", ""], capture_output=True, check=False).returncode == 0
    ]
