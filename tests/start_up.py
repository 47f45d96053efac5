"""The modules that a command imports."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

_SCRIPT = """
import sys
before = set(sys.modules)
from {module} import main
try:
    main({words!r})
except SystemExit:
    pass
imported = sorted(set(sys.modules) - before)
import json
with open({path!r}, "w") as file:
    json.dump(imported, file)
"""


def imported_modules(module: str, words: Sequence[str], directory: Path) -> frozenset[str]:
    """The modules that `main(words)` of `module` imports in a new process."""
    path = directory / "modules.json"
    script = _SCRIPT.format(module=module, words=list(words), path=str(path))
    subprocess.run([sys.executable, "-c", script], capture_output=True, check=True, timeout=60)
    found: list[str] = json.loads(path.read_text())
    return frozenset(found)


def packages(modules: Iterable[str]) -> frozenset[str]:
    """The top-level packages outside the standard library."""
    return frozenset(name.split(".")[0] for name in modules) - sys.stdlib_module_names
