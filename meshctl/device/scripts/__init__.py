"""The shell scripts that meshctl runs on a node (docs/device-scripts.md)."""

from __future__ import annotations

from pathlib import Path

_DIRECTORY = Path(__file__).resolve().parent


def script(name: str) -> str:
    """The text of one script, by its file name: `observe.sh`, `reload.sh`, ..."""
    return (_DIRECTORY / name).read_text(encoding="utf-8")
