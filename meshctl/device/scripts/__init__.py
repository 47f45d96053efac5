"""The shell scripts that meshctl runs on a node (docs/device-scripts.md)."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

_DIRECTORY = Path(__file__).resolve().parent


def script(name: str) -> str:
    """The text of one script, by its file name: `observe.sh`, `reload.sh`, ..."""
    return (_DIRECTORY / name).read_text(encoding="utf-8")


@lru_cache
def code(name: str) -> str:
    """A script without comment lines and indentation, for one that is sent for each use: the node's shell reads it byte
    by byte. Only for scripts in which no quoted text or here-document depends on them."""
    lines = (line.lstrip("\t") for line in script(name).splitlines())
    return "".join(f"{line}\n" for line in lines if line and not line.startswith("#"))
