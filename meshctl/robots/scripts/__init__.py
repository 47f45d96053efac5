"""The shell scripts meshctl runs on a robot's computer, as they are in this directory (docs/robots.md)."""

from __future__ import annotations

import shlex
from pathlib import Path

_DIRECTORY = Path(__file__).resolve().parent


def script(name: str) -> str:
    """The text of one verb (`probe`, `install`, `switch`, ...), with the part that all of them share before it."""
    verb = shipped(f"{name}.sh")
    program = f"health_program={shlex.quote(shipped('health.py'))}\n" if "health " in verb else ""
    return shipped("common.sh") + program + verb


def shipped(name: str) -> str:
    """The text of one file here."""
    return (_DIRECTORY / name).read_text(encoding="utf-8")
